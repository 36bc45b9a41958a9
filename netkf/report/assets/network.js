// The network in motion: nodes with their estimates relative to the truth, messages on their way.
const Network = (() => {
  const MAX_DRAWN = 600; // messages drawn at once; the state in words counts all of them
  const MAX_GLYPHS = 80; // nodes up to which each has its ellipse
  const MOST_SHRUNK = 20;
  const HEIGHT = 420, CAPTION = 36; // pixels; the scale of colours has the lowest of them

  function view(run, canvas, app) {
    const shades = shadeRange(app.runs);
    let places = [], radius = 8, spacing = 40, laid = "", named = true, shrunk = [1, 1];

    function layout(width, whole) {
      const height = whole - CAPTION;
      if (laid === width + " " + height) return;
      laid = width + " " + height;
      const margin = Math.min(run.N <= MAX_GLYPHS ? 64 : 34, width / 8), size = Math.max(1, Math.min(width, height) - 2 * margin);
      const wide = Math.max(1, width - 2 * margin), high = Math.max(1, height - 2 * margin);
      const xs = run.positions.map((p) => p[0]), ys = run.positions.map((p) => p[1]);
      const spanX = Math.max(...xs) - Math.min(...xs) || 1e-9;
      const spanY = Math.max(...ys) - Math.min(...ys) || 1e-9;
      const zoom = Math.min(wide / spanX, high / spanY, 3 * size);
      places = run.positions.map(([x, y]) => [width / 2 + (x - 0.5) * zoom, height / 2 + (y - 0.5) * zoom]);
      spacing = Math.max(12, Math.min(120, (0.7 * size) / Math.sqrt(run.N)));
      radius = Math.max(2.5, Math.min(11, spacing * 0.22));
      named = run.N <= (width > 500 ? 60 : 20);
    }

    function draw(t) {
      const { context, width, height } = Theme.canvas(canvas, HEIGHT);
      layout(width, height);
      const k = State.sampleAt(run, t);
      drawLinks(context);
      shrunk = [1, 1];
      if (run.N <= MAX_GLYPHS && k >= 0) drawEllipses(context, k, width, height - CAPTION);
      drawMessages(context, t);
      drawNodes(context, k);
      drawCaption(context, width, height);
    }

    function drawLinks(context) {
      context.strokeStyle = Theme.colours.faint;
      context.lineWidth = 1;
      context.beginPath();
      for (const [i, j] of run.links) {
        const a = places[run.index.get(i)], b = places[run.index.get(j)];
        if (!a || !b) continue;
        context.moveTo(a[0], a[1]);
        context.lineTo(b[0], b[1]);
      }
      context.stroke();
    }

    // Each node stands for the truth; its ellipse lies where the error puts it. Where one would
    // leave the canvas, as after the start, all are drawn smaller, and the caption says so.
    function drawEllipses(context, k, width, height) {
      const x = State.truthAt(run, k), usual = glyphScale(app.runs, app.axes, spacing);
      const room = [places.map(([px]) => Math.min(px, width - px)), places.map(([, py]) => Math.min(py, height - py))];
      shrunk = usual.map((scale, d) => shrinking(run, k, x, app.axes[d], scale, room[d]));
      const scale = usual.map((size, d) => size * shrunk[d]);
      for (let i = 0; i < run.N; i++) {
        const chosen = i === app.nodeOf(run), s = State.sampleOf(run, k, i);
        context.strokeStyle = chosen ? Theme.colours.ink : Theme.colours.purple;
        context.lineWidth = chosen ? 2 : 1;
        Estimates.glyph(context, run, s, x, app.axes, places[i], scale);
      }
    }

    function drawNodes(context, k) {
      for (let i = 0; i < run.N; i++) {
        const [x, y] = places[i], chosen = i === app.nodeOf(run);
        context.beginPath();
        if (run.sensing[i]) context.rect(x - radius, y - radius, 2 * radius, 2 * radius);
        else context.arc(x, y, radius, 0, 2 * Math.PI);
        context.fillStyle = k < 0 ? Theme.colours.panel : Theme.scale(shade(run, k, i) / shades);
        context.fill();
        context.lineWidth = chosen ? 4 : 1.5;
        context.strokeStyle = Theme.colours.ink;
        context.stroke();
        if (chosen) mark(context, x, y);
        if (named || chosen) Theme.write(context, String(run.names[i]), x + radius + 3, y - radius - 2);
      }
    }

    function mark(context, x, y) {
      context.lineWidth = 1.5;
      context.strokeRect(x - radius - 5, y - radius - 5, 2 * radius + 10, 2 * radius + 10);
    }

    function drawMessages(context, t) {
      let drawn = 0;
      const rings = new Set();
      for (const row of app.filtered(run, State.messagesAt(run, t, app.persist()))) {
        if (drawn++ >= MAX_DRAWN) break;
        drawMessage(context, row, t);
        const m = run.messages, key = m.sender[row] + " " + m.sent[row] + " " + m.phase[row];
        if (run.broadcasts && !rings.has(key)) { rings.add(key); ring(context, row, t); }
      }
    }

    // One transmission, however many may hear it: a ring that grows about its sender.
    function ring(context, row, t) {
      const share = Math.min(1, (t - run.messages.sent[row]) / app.persist());
      const [x, y] = places[run.messages.sender[row]];
      context.globalAlpha = 1 - 0.7 * share;
      context.strokeStyle = Theme.colours.blue;
      context.lineWidth = 2.5;
      context.beginPath();
      context.arc(x, y, radius + 3 + (Theme.calm() ? 6 : share * spacing * 0.55), 0, 2 * Math.PI);
      context.stroke();
      context.globalAlpha = 1;
    }

    function drawMessage(context, row, t) {
      const m = run.messages, state = State.outcomeAt(run, row, t);
      const a = places[m.sender[row]], b = places[m.receiver[row]];
      const share = progress(row, t), lost = m.outcome[row] === State.LOST;
      const reach = lost ? 0.5 : 1;
      const at = (s) => [a[0] + (b[0] - a[0]) * s, a[1] + (b[1] - a[1]) * s];
      const [x, y] = at(reach * (Theme.calm() ? 1 : share));
      context.strokeStyle = colour(m.outcome[row]);
      context.fillStyle = context.strokeStyle;
      context.lineWidth = lost ? 1.5 : 2;
      context.setLineDash(lost ? [4, 3] : []);
      context.beginPath();
      context.moveTo(a[0], a[1]);
      context.lineTo(x, y);
      context.stroke();
      context.setLineDash([]);
      if (lost) cross(context, ...at(0.5));
      else if (m.outcome[row] === State.LATE && state === "late") triangle(context, x, y, m.age[row]);
      else head(context, a, b, [x, y]);
    }

    // The share of its way that a message has gone; messages that take no time are shown to move
    // while they are on show.
    function progress(row, t) {
      const m = run.messages, sent = m.sent[row];
      const ended = Number.isFinite(m.ended[row]) ? m.ended[row] : Math.max(run.horizon, sent) * 1.02;
      const span = ended > sent ? ended - sent : 0.6 * app.persist();
      return Math.min(1, Math.max(0.08, (t - sent) / span));
    }

    function head(context, a, b, [x, y]) {
      const angle = Math.atan2(b[1] - a[1], b[0] - a[0]), size = 7;
      context.beginPath();
      context.moveTo(x, y);
      for (const side of [-1, 1]) {
        context.lineTo(x - size * Math.cos(angle + side * 0.45), y - size * Math.sin(angle + side * 0.45));
      }
      context.closePath();
      context.fill();
    }

    function cross(context, x, y) {
      context.lineWidth = 2.5;
      context.beginPath();
      context.moveTo(x - 5, y - 5); context.lineTo(x + 5, y + 5);
      context.moveTo(x - 5, y + 5); context.lineTo(x + 5, y - 5);
      context.stroke();
    }

    function triangle(context, x, y, age) {
      context.beginPath();
      context.moveTo(x, y - 7); context.lineTo(x + 7, y + 5); context.lineTo(x - 7, y + 5);
      context.closePath();
      context.fill();
      Theme.write(context, Format.number(age) + " s", x + 9, y);
    }

    function drawCaption(context, width, height) {
      context.font = "12px system-ui, sans-serif";
      context.textBaseline = "bottom";
      const what = run.truth ? "error |x - xhat|" : "square root of trace P";
      context.fillStyle = Theme.colours.panel;
      context.fillRect(0, height - CAPTION, width, CAPTION);
      const bar = Math.min(110, width / 4), left = 8, top = height - 10;
      for (let x = 0; x < bar; x++) {
        context.fillStyle = Theme.scale(x / bar);
        context.fillRect(left + x, top - 8, 1.5, 8);
      }
      context.fillStyle = Theme.colours.ink;
      context.fillText(what + ": 0 to " + Format.number(shades) + " or more", left, top - 10);
      const smaller = [...new Set(app.axes)].map((c, d) => [c, shrunk[d]]).filter(([, part]) => part < 1);
      if (!smaller.length) return;
      context.textAlign = "right";
      context.fillText("ellipses drawn smaller: " + smaller.map(([c, part]) => run.states[c] + " " + Math.round(1 / part) + " times").join(", "), width - 8, height - 6);
      context.textAlign = "left";
    }

    function hit(x, y) {
      let best = -1, least = 22;
      places.forEach((place, i) => {
        const gap = Math.hypot(place[0] - x, place[1] - y);
        if (gap < least) { least = gap; best = i; }
      });
      return best;
    }

    return { draw, hit };
  }

  function colour(outcome) {
    if (outcome === State.LOST) return Theme.colours.red;
    return outcome === State.LATE ? Theme.colours.orange : Theme.colours.blue;
  }

  function shade(run, k, i) {
    const s = State.sampleOf(run, k, i);
    return run.truth ? s.error : Math.sqrt(s.trace);
  }

  // Nine of ten samples lie below the end of the scale: one wild node does not make all others light.
  // Runs side by side have one scale.
  function shadeRange(runs) {
    if (runs.shades) return runs.shades;
    const values = [];
    for (const run of runs) for (let k = 0; k < run.samples.count; k++) {
      for (let i = 0; i < run.N; i++) values.push(shade(run, k, i));
    }
    const sorted = values.filter(Number.isFinite).sort((a, b) => a - b);
    runs.shades = sorted[Math.floor(0.9 * (sorted.length - 1))] || 1;
    return runs.shades;
  }

  // Pixels per unit of each of two components: the same for all nodes, times and runs, so that sizes
  // compare, and one for each component, which may have different units.
  function glyphScale(runs, axes, spacing) {
    return axes.map((c) => (0.4 * spacing) / Math.max(...runs.map((run) => usualSize(run, c))));
  }

  // The part of its usual size at which every ellipse stays on the canvas: 1, or one over a whole
  // number. Not beyond MOST_SHRUNK times: a wild node would make all others invisible.
  function shrinking(run, k, x, c, scale, room) {
    let most = 1;
    for (let i = 0; i < run.N; i++) {
      const s = State.sampleOf(run, k, i), off = x ? Math.abs(s.xhat[c] - x[c]) : 0;
      const reach = (off + run.scale.ellipse * Math.sqrt(State.variance(s.P, run.n, c, c))) * scale;
      if (Number.isFinite(reach)) most = Math.max(most, reach / Math.max(1, room[i] - 2));
    }
    return 1 / Math.min(MOST_SHRUNK, Math.ceil(most));
  }

  function usualSize(run, c) {
    run.sizes = run.sizes || {};
    if (!(c in run.sizes)) {
      const sizes = [];
      for (let k = 0; k < run.samples.count; k++) {
        for (let i = 0; i < run.N; i += Math.ceil(run.N / 20)) {
          const size = run.scale.ellipse * Math.sqrt(State.variance(State.sampleOf(run, k, i).P, run.n, c, c));
          if (Number.isFinite(size) && size > 0) sizes.push(size);
        }
      }
      sizes.sort((p, q) => p - q);
      run.sizes[c] = sizes[Math.floor(0.7 * (sizes.length - 1))] || 1;
    }
    return run.sizes[c];
  }

  return { view, colour, shade, shadeRange, MAX_DRAWN };
})();
