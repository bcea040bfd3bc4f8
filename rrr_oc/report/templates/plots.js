// Draws every figure from the page's data, again whenever a choice, the size or the colour scheme changes, and moves what moves.
(() => {
  "use strict";
  const page = JSON.parse(document.getElementById("data").textContent);
  const selects = [...document.querySelectorAll("select[data-choice]")];
  const chosen = () => Object.fromEntries(selects.map((s) => [s.dataset.choice, s.value]));
  const hovers = window.matchMedia("(hover: hover)").matches;
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  // Plotly's own buttons include one that leads to its servers. Without a mouse, dragging scrolls the page.
  const config = { responsive: true, displaylogo: false, displayModeBar: hovers ? "hover" : false, modeBarButtons: [["toImage", "resetScale2d"]] };
  const colour = (role) => getComputedStyle(document.documentElement).getPropertyValue("--" + role).trim();

  // A long column is its range and, in base64, where each number lies in it, in integers of 16 bits; the last one stands for none.
  function numbers(column) {
    if (!column.steps) return column;
    const bytes = Uint8Array.from(atob(column.steps), (c) => c.charCodeAt(0));
    const each = (column.high - column.low) / page.steps;
    return Array.from({ length: bytes.length / 2 }, (_, i) => {
      const step = bytes[2 * i] + 256 * bytes[2 * i + 1];
      return step > page.steps ? null : column.low + step * each;
    });
  }

  // Plotly reads tags in texts.
  const literal = (value) => (typeof value === "string" ? value.replace(/&/g, "&amp;").replace(/</g, "&lt;") : value);

  for (const columns of Object.values(page.data).flatMap(Object.values).filter((columns) => !columns.joined)) {
    for (const name of Object.keys(columns)) columns[name] = numbers(columns[name]).map(literal);
  }

  function columnsOf(table, key) {
    const found = table[key] || {};
    if (found.joined) {
      const parts = found.joined.map((one) => columnsOf(table, one));
      return Object.fromEntries(Object.keys(parts[0] || {}).map((name) => [name, parts.flatMap((part) => part[name])]));
    }
    return found;
  }

  function tracesOf(curve, columns, first) {
    const own = colour(curve.role);
    const trace = {
      type: "scatter", mode: curve.text ? curve.mode + "+text" : curve.mode, name: curve.name, showlegend: first && curve.name !== "",
      x: columns[curve.x], y: columns[curve.y], hoverlabel: { namelength: -1 },
      line: { color: own, width: curve.width, dash: curve.dash },
      marker: { color: own, size: curve.width, symbol: curve.symbol + (curve.hollow ? "-open" : ""), line: { width: curve.hollow ? 2 : 0 } },
    };
    if (curve.moves) Object.assign(trace, picture(curve, columns, 0));
    if (curve.text) Object.assign(trace, { text: columns[curve.text], textposition: "middle right", textfont: { color: colour("soft"), size: 11 } });
    if (curve.colour) trace.marker = { color: columns[curve.colour], size: curve.width, coloraxis: "coloraxis" };
    if (curve.bars) {
      const [minus, plus] = curve.bars;
      trace.error_x = { type: "data", symmetric: false, arrayminus: columns[minus], array: columns[plus], color: own, thickness: 2, width: 0 };
    }
    if (!curve.band) return [trace];
    const edge = { type: "scatter", mode: "lines", x: columns[curve.x], line: { width: 0 }, hoverinfo: "skip", showlegend: false };
    const [low, high] = curve.band.map((name) => columns[name]);
    return [{ ...edge, y: low }, { ...edge, y: high, fill: "tonexty", fillcolor: own + "33" }, trace];
  }

  function layoutOf(figure, columns, many) {
    const axis = (title) => ({
      title: { text: title, standoff: 8 }, gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line"), automargin: true,
    });
    const layout = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colour("ink"), size: 12 }, height: figure.height,
      margin: { l: 50, r: 12, t: many ? 44 : 12, b: 44 }, showlegend: many, hovermode: "closest", dragmode: hovers ? "zoom" : false, autosize: true,
      modebar: { orientation: "v", bgcolor: "rgba(0,0,0,0)", color: colour("soft"), activecolor: colour("accent") },
      hoverlabel: { bgcolor: colour("panel"), font: { color: colour("ink") } },
      legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", itemwidth: 30 },
      xaxis: axis(figure.axes[0]), yaxis: axis(figure.axes[1]),
    };
    if (figure.log) layout[figure.log + "axis"].type = "log";
    if (figure.ticks.length) Object.assign(layout.xaxis, { tickvals: figure.ticks, ticktext: figure.ticks.map(String) });
    if (figure.names) Object.assign(layout.yaxis, { type: "category", autorange: "reversed" });
    if (figure.counts) layout.xaxis.dtick = 1;
    if (figure.equal) Object.assign(layout.yaxis, { scaleanchor: "x", zeroline: false });
    for (const [name, dim] of [["xaxis", "x"], ["yaxis", "y"]]) {
      const moving = figure.equal ? figure.curves.flatMap((c) => (c.moves ? columns[c[dim]] || [] : [])).filter((v) => v !== null) : [];
      if (moving.length) {
        const ends = [Math.min(...moving), Math.max(...moving)], room = 0.08 * (ends[1] - ends[0]) + 0.02;
        layout[name].range = [ends[0] - room, ends[1] + room];
      }
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

  // The points of a moving curve in a picture, of which a figure has as many as points on its path.
  const pictures = (columns) => columns.path_x.length;
  function picture(curve, columns, i) {
    const points = columns[curve.x].length / pictures(columns), part = (name) => columns[name].slice(i * points, (i + 1) * points);
    return { x: part(curve.x), y: part(curve.y) };
  }

  function move(place, curves, columns) {
    clearInterval(place.timer);
    const moving = curves.map((curve, i) => (curve.moves ? i : -1)).filter((i) => i >= 0);
    if (!moving.length || still) return;
    const begin = performance.now(), pause = 0.6, lasts = columns.seconds[0], count = pictures(columns);
    place.timer = setInterval(() => {
      const box = place.getBoundingClientRect();
      if (document.hidden || box.bottom < 0 || box.top > window.innerHeight) return;
      const time = ((performance.now() - begin) / 1000) % (lasts + pause), i = Math.min(count - 1, Math.floor((time / lasts) * count));
      const frame = { data: moving.map((k) => picture(curves[k], columns, i)), traces: moving };
      const atOnce = { mode: "immediate", frame: { duration: 0, redraw: false }, transition: { duration: 0 } };
      window.Plotly.animate(place, frame, atOnce).catch(() => {}); // of a picture that the next one overtakes
    }, 40);
  }

  function draw() {
    const choices = chosen();
    for (const place of document.querySelectorAll("[data-figure]")) {
      const figure = page.figures[place.dataset.figure];
      const key = figure.by.map((name) => choices[name]).join(page.separator);
      const columns = columnsOf(page.data[figure.table], key);
      const curves = figure.curves.filter((curve) => columns[curve.x] && columns[curve.y]);
      const names = curves.map((curve) => curve.name); // in the legend, each once
      place.closest("figure").querySelector("figcaption").textContent = figure.captions[key] || "";
      place.hidden = !curves.length;
      if (place.hidden) continue;
      const traces = curves.flatMap((curve, i) => tracesOf(curve, columns, names.indexOf(curve.name) === i));
      window.Plotly.react(place, traces, layoutOf(figure, columns, new Set(names.filter(Boolean)).size > 1), config);
      move(place, curves, columns);
    }
    for (const part of document.querySelectorAll("[data-of]")) {
      part.hidden = part.dataset.of !== choices[part.dataset.choice];
    }
  }

  selects.forEach((select) => select.addEventListener("change", draw));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
})();
