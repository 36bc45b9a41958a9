// Curves with uPlot: one look, a line at the time of the clock, a click that sets it.
const Curves = (() => {
  const HEIGHT = 240, WHOLE = ["node", "lag (readings)"]; // labels of axes with whole numbers
  const DASHES = { solid: [], dashed: [7, 4], dotted: [2, 3], dashdot: [7, 3, 2, 3] };

  // series: { label, x, y, low, high, colour, dash, width, points, dots, mark }, all over the same x
  // where there is a band; `dots` has no line, nor has `mark` (dot, ring, tick), whose limits are
  // bars. `timed` curves follow the clock; those that are `apart` have a logarithmic scale.
  function figure(app, { title, note, unit, xlabel, names, series, lines, band, timed, apart }) {
    const box = Format.element("div", { class: "plot" });
    const whole = Format.element("figure", { class: "curve" },
      Format.element("figcaption", {}, Format.element("strong", {}, title), " ", note || ""), box,
      legend(series, lines, band));
    const steep = apart || isSteep(series);
    let plot = null, dragged = false;
    function build() {
      if (plot) plot.destroy();
      box.replaceChildren();
      const width = Math.max(260, box.clientWidth);
      plot = new uPlot(options(width), data(series, steep), box);
      box.querySelectorAll("canvas").forEach((canvas) => canvas.setAttribute("aria-hidden", "true"));
      if (!timed) return;
      plot.over.addEventListener("click", () => { if (!dragged) app.setTime(plot.posToVal(plot.cursor.left, "x")); dragged = false; });
      plot.over.addEventListener("dblclick", () => app.setSpan(null));
    }

    function options(width) {
      const axis = { stroke: Theme.colours.ink, grid: { stroke: Theme.colours.faint, width: 1 }, ticks: { stroke: Theme.colours.faint }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
      return {
        width, height: HEIGHT, padding: [12, 12, 0, 0], legend: { show: false },
        // A stretch of time that is dragged over is what all figures over time then show.
        cursor: { drag: { x: Boolean(timed), y: false, setScale: false, dist: 6 }, y: false },
        scales: { x: { time: false, ...(timed ? { range: (u, low, high) => app.span || (app.runs.length ? [0, app.end] : [low, high > low ? high : low + 1]) } : {}), ...(xlabel === "node" ? { range: (u, low, high) => [low - 0.5, high + 0.5] } : {}) }, y: { range: (u, low, high) => yRange(low, high, lines, band, steep) } },
        axes: [{ ...axis, label: xlabel || "time (s)", labelSize: 22, size: 34, values: (u, splits) => splits.map((v) => short(v, 10)),
          ...(WHOLE.includes(xlabel) ? { values: (u, splits) => splits.map((v) => (Number.isInteger(v) ? Format.brief(names && names.has(v) ? names.get(v) : v, 10) : "")) } : {}) }, { ...axis, label: unit, labelFont: Math.min(12, 360 / unit.length) + "px system-ui, sans-serif", labelSize: 20, size: 58, values: (u, splits) => splits.map(steep ? powerOfTen : tick) }],
        series: [{}, ...expanded(series)],
        bands: bandsOf(series),
        hooks: { setSelect: [(u) => {
          if (!timed || u.select.width < 6) return;
          dragged = true;
          app.setSpan([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]);
        }], drawClear: [(u) => drawBand(u, band, steep)], draw: [(u) => overlay(u, lines, timed ? app.time : null, steep), (u) => drawMarks(u, series, steep)] },
      };
    }
    return { whole, build, redraw: () => plot && plot.redraw(false) };
  }

  function tick(value) {
    if (!Number.isFinite(value)) return "";
    return Math.abs(value) >= 1e5 ? Format.number(value) : short(value, 6);
  }

  // Small numbers with an exponent, which has room beside the label of an axis.
  function short(value, digits) {
    const rounded = Number(value.toPrecision(digits));
    return rounded !== 0 && Math.abs(rounded) < 1e-3 ? rounded.toExponential() : String(rounded);
  }

  function powerOfTen(value) {
    return Number.isInteger(value) ? "1e" + value : "";
  }

  function yRange(low, high, lines, band, steep) {
    const marked = [...(lines || []).map((line) => line.y), ...(band || [])];
    const all = [low, high, ...marked.map((y) => scaled(y, steep))].filter(Number.isFinite);
    if (!all.length) return [0, 1];
    if (steep) return [Math.floor(Math.min(...all)), Math.ceil(Math.max(...all))];
    const top = Math.max(...all), bottom = Math.min(0, ...all);
    return [bottom, top > bottom ? top + 0.06 * (top - bottom) : bottom + 1];
  }

  function colour(name) {
    return Theme.colours[name] || name;
  }

  function expanded(series) {
    return series.flatMap((s) => {
      const line = { label: s.label, stroke: () => colour(s.colour), width: s.width || 1.5, dash: DASHES[s.dash || "solid"], points: { show: Boolean(s.points || s.dots), size: s.dots ? 4 : 7 }, spanGaps: false, ...(s.dots || s.mark ? { paths: () => null } : {}) };
      const edge = { ...line, width: 0, stroke: "transparent", points: { show: false } };
      return s.low ? [line, { ...edge, paths: line.paths }, { ...edge, paths: line.paths }] : [line];
    });
  }

  function bandsOf(series) {
    const found = [];
    let at = 1;
    for (const s of series) {
      if (s.low && !s.mark) found.push({ series: [at + 2, at + 1], fill: () => faded(colour(s.colour)) });
      at += s.low ? 3 : 1;
    }
    return found;
  }

  function faded(name) {
    return /^#[0-9a-f]{6}$/i.test(name) ? name + "38" : name;
  }

  // Curves that grow over orders of magnitude, as those of unstable plants, have a logarithmic
  // scale: their logarithms are drawn, since uPlot's own scale ends at 1e32.
  function isSteep(series) {
    const values = series.flatMap((s) => Array.from(s.y)).filter((v) => v !== null && Number.isFinite(v) && v !== 0);
    if (!values.length || values.some((v) => v < 0)) return false;
    values.sort((a, b) => a - b);
    return values[values.length - 1] > 100 * values[Math.floor(values.length / 2)];
  }

  function scaled(value, steep) {
    return steep ? (value > 0 ? Math.log10(value) : NaN) : value;
  }

  function data(series, steep) {
    const tables = series.map((s) => {
      const columns = s.low ? [s.y, s.low, s.high] : [s.y];
      const known = (value) => (Number.isFinite(value) ? value : null);
      return [Array.from(s.x, known), ...columns.map((column) => Array.from(column, (v) => known(scaled(v, steep))))];
    });
    return tables.length ? uPlot.join(tables) : [[]];
  }

  function drawBand(u, band, steep) {
    if (!band) return;
    const [bottom, top] = band.map((y) => u.valToPos(scaled(y, steep), "y", true)), { ctx, bbox } = u;
    ctx.save();
    ctx.fillStyle = faded(Theme.colours.green);
    ctx.fillRect(bbox.left, top, bbox.width, bottom - top);
    ctx.restore();
  }

  function drawMarks(u, series, steep) {
    const { ctx } = u, size = 4 * devicePixelRatio;
    ctx.save();
    ctx.lineWidth = 1.8 * devicePixelRatio;
    for (const s of series.filter((one) => one.mark)) {
      ctx.strokeStyle = ctx.fillStyle = colour(s.colour);
      const at = (value) => u.valToPos(scaled(value, steep), "y", true);
      Array.from(s.x).forEach((value, k) => {
        const x = u.valToPos(value, "x", true), y = at(s.y[k]);
        if (!Number.isFinite(y)) return;
        ctx.beginPath();
        if (s.mark === "tick") { ctx.moveTo(x - size, y); ctx.lineTo(x + size, y); }
        else ctx.arc(x, y, size, 0, 2 * Math.PI);
        if (s.low) { ctx.moveTo(x, at(s.low[k])); ctx.lineTo(x, at(s.high[k])); }
        ctx.stroke();
        if (s.mark === "dot") ctx.fill();
      });
    }
    ctx.restore();
  }

  function overlay(u, lines, time, steep) {
    const { ctx, bbox } = u;
    ctx.save();
    for (const line of lines || []) {
      const y = u.valToPos(scaled(line.y, steep), "y", true);
      ctx.strokeStyle = colour(line.colour);
      ctx.lineWidth = 1.5 * devicePixelRatio;
      ctx.setLineDash((DASHES[line.dash] || []).map((part) => part * devicePixelRatio));
      ctx.beginPath(); ctx.moveTo(bbox.left, y); ctx.lineTo(bbox.left + bbox.width, y); ctx.stroke();
    }
    if (time !== null) {
      const x = u.valToPos(time, "x", true);
      ctx.setLineDash([]);
      ctx.strokeStyle = Theme.colours.ink;
      ctx.lineWidth = devicePixelRatio;
      ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke();
    }
    ctx.restore();
  }

  function legend(series, lines, band) {
    const list = Format.element("ul", { class: "series" });
    for (const s of [...series, ...(lines || [])]) {
      const sample = Format.element("svg", { width: 34, height: 10, "aria-hidden": "true" },
        s.dots || (s.mark && s.mark !== "tick") ? Format.element("circle", { cx: 17, cy: 5, r: s.mark ? 3.5 : 2.5, class: "swatch " + s.colour, "stroke-width": 2, fill: s.mark === "ring" ? "none" : colour(s.colour) }) : Format.element("line", { x1: 0, x2: 34, y1: 5, y2: 5, class: "swatch " + s.colour, "stroke-width": Math.max(2, s.width || 1.5),
          "stroke-dasharray": DASHES[s.dash || "solid"].join(" ") || null }));
      list.append(Format.element("li", {}, sample, " " + s.label + (s.y && s.y.length === undefined ? " " + Format.number(s.y) : "")));
    }
    if (band) list.append(Format.element("li", {}, Format.element("span", { class: "key band", "aria-hidden": "true" }),
      " 95 % where P is exact: " + Format.number(band[0]) + " .. " + Format.number(band[1])));
    return list;
  }

  return { figure };
})();
