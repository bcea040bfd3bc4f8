// Draws every figure from the page's data, again whenever a choice, the size or the colour scheme changes.
(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("data").textContent);
  const selects = [...document.querySelectorAll("select[data-choice]")];
  const chosen = () => Object.fromEntries(selects.map((s) => [s.dataset.choice, s.value]));
  const hovers = window.matchMedia("(hover: hover)").matches;
  // Plotly's own buttons include one that leads to its servers. Without a mouse, dragging scrolls the page.
  const config = { responsive: true, displaylogo: false, displayModeBar: hovers ? "hover" : false, modeBarButtons: [["toImage", "resetScale2d"]] };
  const colour = (role) => getComputedStyle(document.documentElement).getPropertyValue("--" + role).trim();

  function columnsOf(table, key) {
    const found = table[key] || {};
    if (!found.joined) return found;
    const parts = found.joined.map((one) => table[one]);
    return Object.fromEntries(Object.keys(parts[0] || {}).map((name) => [name, parts.flatMap((part) => part[name])]));
  }

  function traceOf(curve, columns, first) {
    const trace = {
      type: "scatter", mode: curve.mode, name: curve.name, showlegend: first, x: columns[curve.x], y: columns[curve.y], hoverlabel: { namelength: -1 },
      line: { color: colour(curve.role), width: curve.width, dash: curve.dash },
      marker: { color: colour(curve.role), size: curve.width },
    };
    if (curve.colour) trace.marker = { color: columns[curve.colour], size: curve.width, coloraxis: "coloraxis" };
    if (curve.bars) {
      const [minus, plus] = curve.bars;
      trace.error_x = { type: "data", symmetric: false, arrayminus: columns[minus], array: columns[plus], color: colour(curve.role), thickness: 2, width: 0 };
    }
    return trace;
  }

  function layoutOf(figure, columns, many) {
    const axis = (title) => ({
      title: { text: title, standoff: 8 }, gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line"), automargin: true,
    });
    const layout = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colour("ink"), size: 12 },
      margin: { l: 50, r: 12, t: many ? 44 : 12, b: 44 }, showlegend: many, hovermode: "closest", dragmode: hovers ? "zoom" : false, autosize: true,
      modebar: { orientation: "v", bgcolor: "rgba(0,0,0,0)", color: colour("soft"), activecolor: colour("accent") },
      hoverlabel: { bgcolor: colour("panel"), font: { color: colour("ink") } },
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", itemwidth: 30 },
      xaxis: axis(figure.axes[0]), yaxis: axis(figure.axes[1]),
    };
    for (const [name, value] of Object.entries(figure.layout)) {
      layout[name] = typeof layout[name] === "object" ? Object.assign(layout[name], value) : value;
    }
    if (figure.limit && columns[figure.limit]) {
      const end = columns[figure.limit][0];
      layout.coloraxis = {
        cmin: -end, cmax: end, colorscale: [[0, colour("cold")], [0.5, colour("middle")], [1, colour("warm")]],
        colorbar: { title: { text: "[Nm]" }, thickness: 10, outlinewidth: 0, xpad: 4 },
      };
    }
    return layout;
  }

  function draw() {
    const choices = chosen();
    for (const place of document.querySelectorAll("[data-figure]")) {
      const figure = page.figures[place.dataset.figure];
      const key = figure.by.map((name) => choices[name]).join(page.separator);
      const columns = columnsOf(page.data[figure.data], key);
      const curves = figure.curves.filter((curve) => columns[curve.x] && columns[curve.y]);
      const names = curves.map((curve) => curve.name); // in the legend, each once
      const layout = layoutOf(figure, columns, curves.length > 1);
      place.closest("figure").querySelector("figcaption").textContent = figure.captions[key] || "";
      window.Plotly.react(place, curves.map((curve, i) => traceOf(curve, columns, names.indexOf(curve.name) === i)), layout, config);
    }
    for (const part of document.querySelectorAll("[data-of]")) {
      part.hidden = part.dataset.of !== choices[part.dataset.choice];
    }
  }

  selects.forEach((select) => select.addEventListener("change", draw));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
})();
