// Estimates with their 95 % ellipses (intervals for one component) beside the truth.
const Estimates = (() => {
  const HEIGHT = 420, LEFT = 62, BOTTOM = 40, TOP = 14, RIGHT = 12;

  function glyph(context, run, s, x, [a, b], [px, py], [wide, high]) {
    const off = x ? [s.xhat[a] - x[a], s.xhat[b] - x[b]] : [0, 0];
    context.beginPath();
    if (a === b) {
      const half = run.scale.interval * Math.sqrt(State.variance(s.P, run.n, a, a)) * high;
      const y = py - off[0] * high;
      context.moveTo(px, y - half); context.lineTo(px, y + half);
      context.moveTo(px - 5, y); context.lineTo(px + 5, y);
    } else {
      const cx = px + off[0] * wide, cy = py - off[1] * high;
      const curve = outline(run, s, a, b);
      if (!Number.isFinite(cx * cy * curve[0][0])) return;
      for (const [u, v] of curve) context.lineTo(cx + u * wide, cy - v * high);
      context.moveTo(px, py); context.lineTo(cx, cy); // the error itself
      context.moveTo(cx - 3, cy); context.lineTo(cx + 3, cy);
      context.moveTo(cx, cy - 3); context.lineTo(cx, cy + 3);
    }
    context.stroke();
  }

  // Points of the 95 % ellipse around the estimate. Axes may have different units, so that it is a
  // curve of points rather than a shape.
  function outline(run, s, a, b) {
    const n = run.n, shape = State.ellipse(State.variance(s.P, n, a, a), State.variance(s.P, n, a, b),
      State.variance(s.P, n, b, b), run.scale.ellipse);
    const cos = Math.cos(shape.angle), sin = Math.sin(shape.angle);
    return Array.from({ length: 49 }, (_, p) => {
      const u = shape.major * Math.cos((p * Math.PI) / 24), v = shape.minor * Math.sin((p * Math.PI) / 24);
      return [u * cos - v * sin, u * sin + v * cos];
    });
  }

  function view(run, canvas, app) {
    function draw(t) {
      const { context, width, height } = Theme.canvas(canvas, HEIGHT);
      const k = State.sampleAt(run, t);
      if (k < 0) return Theme.write(context, "no sample before this time", 12, 30);
      const nodes = run.nodes.map((_, i) => State.sampleOf(run, k, i));
      const x = State.truthAt(run, k), [a, b] = app.axes;
      if (a === b) drawIntervals(context, width, height, nodes, x, a, spanOf(t, a));
      else drawEllipses(context, width, height, nodes, x, [a, b], [spanOf(t, a), spanOf(t, b)]);
    }

    // Runs side by side have one range.
    function spanOf(t, a) {
      const spans = app.runs.filter((one) => a < one.n).map((one) => {
        const k = State.sampleAt(one, t);
        return app.range === "run" || k < 0 ? wholeRange(one, a)
          : rangeNow(one, one.nodes.map((_, i) => State.sampleOf(one, k, i)), State.truthAt(one, k), a);
      });
      return [Math.min(...spans.map((s) => s[0])), Math.max(...spans.map((s) => s[1]))];
    }

    function drawEllipses(context, width, height, nodes, x, [a, b], spans) {
      const axes = frame(context, width, height, spans, [run.states[a], run.states[b]]);
      nodes.forEach((s, i) => { if (i !== app.nodeOf(run)) ellipse(context, axes, s, a, b, false); });
      if (app.nodeOf(run) >= 0) ellipse(context, axes, nodes[app.nodeOf(run)], a, b, true);
      if (x) truth(context, axes.x(x[a]), axes.y(x[b]));
      if (x) Theme.write(context, "truth", axes.x(x[a]) + 10, axes.y(x[b]) + 10);
      finish(context);
    }

    function ellipse(context, axes, s, a, b, chosen) {
      const curve = outline(run, s, a, b);
      if (!Number.isFinite(curve[0][0] * s.xhat[a] * s.xhat[b])) return;
      context.strokeStyle = chosen ? Theme.colours.ink : Theme.colours.purple;
      context.lineWidth = chosen ? 2.5 : 1;
      context.beginPath();
      for (const [u, v] of curve) context.lineTo(axes.x(s.xhat[a] + u), axes.y(s.xhat[b] + v));
      context.stroke();
      dot(context, axes.x(s.xhat[a]), axes.y(s.xhat[b]), chosen ? 4 : 2.5);
      if (chosen) Theme.write(context, "node " + run.names[app.nodeOf(run)], axes.x(s.xhat[a]) + 7, axes.y(s.xhat[b]) - 8);
    }

    function drawIntervals(context, width, height, nodes, x, a, span) {
      const axes = frame(context, width, height, [[-0.7, run.N - 0.3], span], ["", run.states[a]], run.names);
      if (x) {
        context.strokeStyle = Theme.colours.green;
        context.lineWidth = 2;
        context.beginPath();
        context.moveTo(LEFT, axes.y(x[a])); context.lineTo(width - RIGHT, axes.y(x[a]));
        context.stroke();
      }
      nodes.forEach((s, i) => interval(context, axes, s, i, a));
      finish(context);
    }

    function interval(context, axes, s, i, a) {
      const half = run.scale.interval * Math.sqrt(State.variance(s.P, run.n, a, a));
      const chosen = i === app.nodeOf(run);
      context.strokeStyle = chosen ? Theme.colours.ink : Theme.colours.purple;
      context.lineWidth = chosen ? 3.5 : 1.5;
      context.beginPath();
      context.moveTo(axes.x(i), axes.y(s.xhat[a] - half));
      context.lineTo(axes.x(i), axes.y(s.xhat[a] + half));
      context.stroke();
      dot(context, axes.x(i), axes.y(s.xhat[a]), chosen ? 5 : 3);
    }

    // Words on the frame are drawn last: the frame clips what is outside of it.
    function finish(context) {
      context.restore();
      Theme.write(context, (app.axes[0] === app.axes[1] ? "bars: 95 %; " + (run.truth ? "line: truth" : "no truth is known")
        : "ellipses: 95 %" + (run.truth ? "" : "; no truth is known")), LEFT + 6, TOP + 10);
    }

    return { draw };
  }

  function truth(context, x, y) {
    context.strokeStyle = Theme.colours.green;
    context.lineWidth = 4;
    context.beginPath();
    context.moveTo(x - 7, y - 7); context.lineTo(x + 7, y + 7);
    context.moveTo(x - 7, y + 7); context.lineTo(x + 7, y - 7);
    context.stroke();
  }

  function dot(context, x, y, radius) {
    context.fillStyle = context.strokeStyle;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fill();
  }

  function pad([low, high]) {
    if (!(high > low)) return Number.isFinite(low) ? [low - 1, low + 1] : [-1, 1];
    const margin = 0.06 * (high - low);
    return [low - margin, high + margin];
  }

  function rangeNow(run, nodes, x, a) {
    const ends = x ? [x[a]] : [];
    for (const s of nodes) {
      const half = run.scale.ellipse * Math.sqrt(State.variance(s.P, run.n, a, a));
      ends.push(s.xhat[a] - half, s.xhat[a] + half);
    }
    const kept = ends.filter(Number.isFinite);
    return pad([Math.min(...kept), Math.max(...kept)]);
  }

  function wholeRange(run, a) {
    run.ranges = run.ranges || {};
    if (!run.ranges[a]) {
      let low = Infinity, high = -Infinity;
      for (let k = 0; k < run.samples.count; k++) {
        const nodes = run.nodes.map((_, i) => State.sampleOf(run, k, i));
        const now = rangeNow(run, nodes, State.truthAt(run, k), a);
        if (now.every(Number.isFinite)) { low = Math.min(low, now[0]); high = Math.max(high, now[1]); }
      }
      run.ranges[a] = pad([low, high]);
    }
    return run.ranges[a];
  }

  // Axes with round ticks; returns the maps from values to pixels.
  function frame(context, width, height, [spanX, spanY], names, nodes) {
    const right = width - RIGHT, bottom = height - BOTTOM;
    const x = (value) => LEFT + ((value - spanX[0]) / (spanX[1] - spanX[0])) * (right - LEFT);
    const y = (value) => bottom - ((value - spanY[0]) / (spanY[1] - spanY[0])) * (bottom - TOP);
    context.font = "12px system-ui, sans-serif";
    context.fillStyle = Theme.colours.soft;
    context.strokeStyle = Theme.colours.faint;
    context.lineWidth = 1;
    context.beginPath();
    context.textBaseline = "middle";
    context.textAlign = "right";
    for (const tick of ticks(spanY, 6)) {
      context.moveTo(LEFT, y(tick)); context.lineTo(right, y(tick));
      context.fillText(tickText(tick, spanY), LEFT - 5, y(tick));
    }
    context.textAlign = "center";
    for (const tick of nodes ? nodeTicks(nodes, right - LEFT) : ticks(spanX, Math.max(2, width / 90))) {
      context.moveTo(x(tick), TOP); context.lineTo(x(tick), bottom);
      context.fillText(nodes ? nodes[tick] : tickText(tick, spanX), x(tick), bottom + 11);
    }
    context.stroke();
    context.fillStyle = Theme.colours.ink;
    context.fillText(nodes ? "node" : names[0], (LEFT + right) / 2, height - 9);
    context.save();
    context.translate(10, (TOP + bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(names[1], 0, 0);
    context.restore();
    context.save();
    context.beginPath();
    context.rect(LEFT, TOP, right - LEFT, bottom - TOP);
    context.clip();
    return { x, y };
  }

  function nodeTicks(nodes, width) {
    const step = Math.ceil(nodes.length / Math.max(1, width / 26));
    return nodes.map((_, i) => i).filter((i) => i % step === 0);
  }

  function ticks([low, high], count) {
    const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
    const found = [];
    for (let k = Math.ceil(low / step); k * step <= high && found.length < 50; k++) found.push(k * step);
    return found;
  }

  function tickText(value, [low, high]) {
    const digits = Math.max(0, Math.min(12, 1 - Math.floor(Math.log10((high - low) / 5))));
    // Two digits tell large numbers apart that begin near 0, and not those of a map.
    const largest = Math.max(Math.abs(low), Math.abs(high)), far = largest / (high - low);
    const short = Math.abs(value) >= 1e5 && (far < 4 || far > 1e8);
    return short || high - low < 1e-6 ? value.toExponential(1) : String(Number(value.toFixed(digits)));
  }

  return { view, glyph, ticks };
})();
