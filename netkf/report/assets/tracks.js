// A row for each node, coloured by its error, and one for each link with its messages, over the run.
const Tracks = (() => {
  const LEFT = 92, RIGHT = 12, TOP = 6, BOTTOM = 24, ROW = 13, GAP = 8;
  const MAX_NODES = 60, MAX_LINKS = 80; // rows; the note says which are left out

  // The links with messages of each run, those into and out of the node first where they are many.
  function linksOf(app, run) {
    const all = run.messages.into.flatMap((links, i) => links.map((link) => ({ ...link, receiver: i })));
    const i = app.nodeOf(run), own = (link) => link.sender === i || link.receiver === i;
    if (all.length <= MAX_LINKS) return all;
    return [...all.filter(own), ...all.filter((link) => !own(link))].slice(0, MAX_LINKS);
  }

  function nodesOf(app, run) {
    const all = run.nodes.map((_, i) => i), i = app.nodeOf(run);
    return run.N <= MAX_NODES ? all : [i, ...all.filter((k) => k !== i)].slice(0, MAX_NODES);
  }

  function rowsOf(app) {
    return app.runs.flatMap((run, r) => {
      const mark = app.runs.length > 1 ? "AB"[r] + " " : "";
      return [...nodesOf(app, run).map((i) => ({ run, i, mark: mark + "node ", ends: [run.names[i]] })),
        ...linksOf(app, run).map((link) => ({ run, link, i: link.receiver, mark, ends: [run.names[link.sender], run.names[link.receiver]] }))];
    });
  }

  function scaleOf(app, width) {
    const [from, to] = app.span || [0, app.end];
    return { from, to, x: (t) => LEFT + ((t - from) / (to - from)) * (width - LEFT - RIGHT),
      t: (x) => from + ((x - LEFT) / (width - LEFT - RIGHT)) * (to - from) };
  }

  let still = null, stillOf = "";

  // Everything but the line at the time of the clock is drawn once for a stretch of time and a node.
  function draw(target, note, app) {
    const rows = rowsOf(app), bottom = TOP + rows.length * ROW + GAP, height = bottom + BOTTOM;
    target.style.height = height + "px";
    const { context, width } = Theme.canvas(target, height), scale = scaleOf(app, width);
    const key = [width, devicePixelRatio, app.span, app.focus, app.nodeId, Theme.colours.ink, app.runs.map((run) => run.replica)].join();
    if (key !== stillOf) {
      rows.forEach((row, k) => drawRow(context, app, row, TOP + k * ROW, scale, width));
      drawAxis(context, scale, bottom);
      still = document.createElement("canvas");
      [still.width, still.height, stillOf] = [target.width, target.height, key];
      still.getContext("2d").drawImage(target, 0, 0);
      note.textContent = words(app);
    } else context.drawImage(still, 0, 0, width, height);
    context.fillStyle = Theme.colours.ink;
    if (app.time >= scale.from && app.time <= scale.to) context.fillRect(scale.x(app.time) - 0.75, TOP, 1.5, bottom - TOP);
  }

  function drawRow(context, app, row, y, scale, width) {
    context.save();
    context.beginPath();
    context.rect(LEFT, y, width - LEFT - RIGHT, ROW);
    context.clip();
    if (row.link) drawLink(context, row, y, scale);
    else drawNode(context, row, y, scale, Network.shadeRange(app.runs));
    context.restore();
    drawName(context, row, y, !row.link && row.i === app.nodeOf(row.run));
  }

  // From one sample to the next the colour of its error, as in the network.
  function drawNode(context, { run, i }, y, { x }, shades) {
    const t = run.samples.t;
    for (let k = 0; k < t.length; k++) {
      const left = x(t[k]), right = x(k + 1 < t.length ? t[k + 1] : run.horizon);
      if (right < LEFT) continue;
      context.fillStyle = Theme.scale(Network.shade(run, k, i) / shades);
      context.fillRect(left, y + 1, Math.max(1, right - left + 0.5), ROW - 3);
    }
    context.fillStyle = Theme.colours.purple;
    for (let k = 0; k < run.marks.t.length; k++) {
      if (run.marks.node[k] === i && run.marks.names[run.marks.kind[k]] !== "swap") context.fillRect(x(run.marks.t[k]) - 1, y, 2, ROW);
    }
  }

  // Delivered messages are low ticks, lost and late ones high.
  function drawLink(context, { run, link }, y, { x }) {
    const m = run.messages;
    for (let k = link.from; k < link.to; k++) {
      const bad = m.outcome[k] !== State.DELIVERED;
      context.fillStyle = Network.colour(m.outcome[k]);
      context.fillRect(x(m.sent[k]) - 0.5, bad ? y + 1 : y + ROW / 2, bad ? 1.6 : 1, bad ? ROW - 3 : ROW / 2 - 2);
    }
  }

  function drawName(context, row, y, chosen) {
    context.font = (chosen ? "bold " : "") + "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    context.textAlign = "right";
    context.fillStyle = Theme.colours.ink;
    const named = (most) => row.mark + row.ends.map((end) => Format.brief(end, most)).join(" \u2192 ");
    let most = 16;
    while (most > 2 && context.measureText(named(most)).width > LEFT - 8) most -= 1;
    context.fillText(named(most), LEFT - 6, y + ROW / 2);
  }

  function drawAxis(context, scale, y) {
    context.textAlign = "center";
    context.font = "12px system-ui, sans-serif";
    for (const tick of Estimates.ticks([scale.from, scale.to], 10)) context.fillText(Format.time(tick) + " s", Math.max(LEFT + 8, scale.x(tick)), y + 10);
  }

  function words(app) {
    const left = app.runs.map((run) => [run.N - nodesOf(app, run).length, run.messages.into.flat().length - linksOf(app, run).length]);
    const nodes = left.reduce((sum, one) => sum + one[0], 0), links = left.reduce((sum, one) => sum + one[1], 0);
    const rest = nodes || links ? " Left out: " + Format.count(nodes) + " nodes and " + Format.count(links) + " links; those of the chosen node come first." : "";
    return "Nodes: colour as in the network, the darker the larger; links: short marks are delivered messages, long ones lost or late. Drag to look closer, click to set the time and the node." + rest;
  }

  // A click sets time and node, a drag the stretch of time.
  function listen(target, app) {
    const timeAt = (x) => scaleOf(app, target.clientWidth).t(x);
    Brush.listen(target, app, "x", timeAt, ({ x, y }) => {
      const row = rowsOf(app)[Math.floor((y - TOP) / ROW)];
      if (row) { app.focusOn(row.run); app.setNode(row.i); }
      app.setTime(timeAt(x));
    });
  }

  return { draw, listen };
})();
