// Every equation of a page, from the LaTeX that its source has in blocks of ```math.
for (const place of document.querySelectorAll(".arithmatex"))
  katex.render(place.textContent.replace(/^\s*\\\[|\\\]\s*$/g, ""), place, { displayMode: true });
