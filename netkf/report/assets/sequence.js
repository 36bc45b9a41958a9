// The sequence chart: a lifeline for each chosen node, time downwards, an arrow for each message.
const Sequence = (() => {
  const HEIGHT = 480, TOP = 34, LEFT = 70, RIGHT = 66, BOTTOM = 14;
  const MAX_ARROWS = 220, MAX_NEAR = 7, MAX_LOSERS = 4;
  const make = Format.element;

  // The chosen node and those it has heard most recently.
  function near(run, node, t) {
    const heard = run.messages.into[node].map((link) => ({
      sender: link.sender, at: Why.heard(run, link, t).sent,
    }));
    heard.sort((a, b) => b.at - a.at);
    return [node, ...heard.slice(0, MAX_NEAR).map((h) => h.sender)].sort((a, b) => a - b);
  }

  function rows(run, chosen, start, end) {
    const m = run.messages, inside = new Set(chosen), found = [];
    for (let k = State.firstSent(m, start - m.longest); k < m.bySent.length; k++) {
      const row = m.bySent[k];
      if (m.sent[row] > end) break;
      if (!inside.has(m.sender[row]) || !inside.has(m.receiver[row])) continue;
      if (m.sent[row] >= start || (Number.isFinite(m.ended[row]) && m.ended[row] >= start)) found.push(row);
    }
    return found;
  }

  // The messages to draw of the stretch of time that all charts show, else of the window, with half
  // of the width until no more than MAX_ARROWS are left around t.
  function narrow(run, chosen, t, app) {
    const [low, high] = app.span || [0, Infinity];
    for (let width = widest(app); ; width /= 2) {
      const start = Math.max(low, Math.min(t - 0.75 * width, high - width)), end = start + width;
      const found = app.filtered(run, rows(run, chosen, start, end));
      if (found.length <= MAX_ARROWS || width < 1e-9 * run.horizon) return { found, start, end, width };
    }
  }

  const widest = (app) => (app.span ? app.span[1] - app.span[0] : app.window);

  // Instants of several transmissions, such as slots, are spread a little: y then orders what time
  // alone does not tell apart.
  function heights(run, found, start, end) {
    const m = run.messages, scale = (HEIGHT - TOP - BOTTOM) / (end - start), groups = new Map();
    for (const row of found) {
      const at = m.sent[row], key = m.phase[row] + " " + (run.broadcasts ? m.sender[row] : row);
      if (!groups.has(at)) groups.set(at, new Map());
      const ranks = groups.get(at);
      if (!ranks.has(key)) ranks.set(key, ranks.size);
    }
    const instants = [...groups.keys()].sort((a, b) => a - b);
    const room = new Map(instants.map((at, k) => {
      const next = k + 1 < instants.length ? instants[k + 1] : end + (end - start) * 0.05;
      return [at, Math.min(0.85 * (next - at) * scale, 12 * groups.get(at).size)];
    }));
    const y = (time) => TOP + (time - start) * scale;
    const sent = (row) => {
      const ranks = groups.get(m.sent[row]);
      const key = m.phase[row] + " " + (run.broadcasts ? m.sender[row] : row);
      return y(m.sent[row]) + (ranks.size > 1 ? (room.get(m.sent[row]) * ranks.get(key)) / ranks.size : 0);
    };
    const ended = (row) => (m.ended[row] === m.sent[row] ? sent(row) : y(Math.min(m.ended[row], run.horizon * 1.02)));
    return { y, sent, ended };
  }

  let timeAt = null; // seconds at a height of what was drawn last

  function listen(box, app) {
    Brush.listen(box, app, "y", (y) => timeAt(y), ({ y }) => { if (y > TOP) app.setTime(timeAt(y)); });
  }

  function draw(box, note, run, app) {
    const chosen = app.lifelines === "near" ? near(run, app.nodeOf(run), app.time) : app.picks.slice();
    const { found, start, end, width } = narrow(run, chosen, app.time, app);
    const wide = Math.max(box.clientWidth - 2, LEFT + RIGHT + 44 * chosen.length);
    const step = (wide - LEFT - RIGHT) / Math.max(1, chosen.length - 1 || 1);
    const x = new Map(chosen.map((i, k) => [i, chosen.length > 1 ? LEFT + 14 + (k * (step * (chosen.length - 1) - 28)) / (chosen.length - 1) : wide / 2]));
    x.gap = chosen.length > 1 ? Math.abs(x.get(chosen[1]) - x.get(chosen[0])) : 0;
    const at = heights(run, found, start, end), drawn = found.filter((row) => at.sent(row) <= HEIGHT - BOTTOM);
    const svg = make("svg", {
      width: wide, height: HEIGHT, role: "img", class: "sequence",
      "aria-label": describe(run, chosen, drawn, start, end),
    });
    drawFrame(svg, at, start, end, wide);
    drawLifelines(svg, run, app, chosen, x, at, start, end);
    for (const row of drawn) svg.append(arrow(run, row, x, at));
    if (run.broadcasts) drawLosers(svg, run, drawn, x, at);
    if (app.time >= start && app.time <= end) drawClock(svg, at, app.time, wide);
    timeAt = (y) => start + ((Math.max(y, TOP) - TOP) / (HEIGHT - TOP - BOTTOM)) * (end - start);
    box.replaceChildren(svg);
    showChosen(box, x, app.nodeOf(run), wide);
    note.textContent = words(run, drawn, start, end, width, app);
  }

  // On a narrow screen the chart scrolls sideways: a node that has just been chosen is in view.
  function showChosen(box, x, node, wide) {
    const shown = [node, ...x.keys()].join(" ");
    if (box.dataset.shown === shown) return;
    box.dataset.shown = shown;
    if (x.has(node) && wide > box.clientWidth) box.scrollLeft = x.get(node) - box.clientWidth / 2;
  }

  function describe(run, chosen, found, start, end) {
    const names = chosen.map((i) => run.names[i]).join(", ");
    return "Sequence chart of nodes " + names + " from " + Format.time(start) + " to " +
      Format.time(end) + " seconds, " + found.length + " messages; the table of messages has them in words";
  }

  function words(run, found, start, end, width, app) {
    let said = Format.count(found.length) + " messages" + app.filterWords() + " from " + Format.time(start) + " to " + Format.time(end) + " s";
    if (width < widest(app)) said += "; the window is narrowed so that they can be told apart";
    const m = run.messages;
    if (m.step > 1 && (start < m.start || end > m.end)) {
      said += "; outside of " + Format.time(m.start) + " to " + Format.time(m.end) +
        " s the page holds only every " + m.step + "th message of a link";
    }
    return said + ". Messages sent at one instant, such as the two of an exchange, are drawn one below the other. " +
      "Ticks on a lifeline are readings of its sensor.";
  }

  function drawFrame(svg, at, start, end, wide) {
    for (const tick of Estimates.ticks([start, end], 8)) {
      const y = at.y(tick);
      svg.append(make("line", { x1: LEFT - 6, x2: wide, y1: y, y2: y, class: "grid" }),
        make("text", { x: LEFT - 10, y: y + 4, "text-anchor": "end" }, Format.time(tick)));
    }
    svg.append(make("text", { x: 4, y: 14 }, "seconds"));
  }

  function drawLifelines(svg, run, app, chosen, x, at, start, end) {
    for (const i of chosen) {
      const line = i === app.nodeOf(run) ? "lifeline chosen" : "lifeline";
      const name = make("text", { x: x.get(i), y: 16, "text-anchor": "middle", class: i === app.nodeOf(run) ? "chosen" : "" },
        (run.sensing[i] ? "\u25a0 " : "\u25cf ") + run.names[i]);
      name.addEventListener("click", (event) => { event.stopPropagation(); app.setNode(i); });
      svg.append(name, make("line", { x1: x.get(i), x2: x.get(i), y1: TOP - 8, y2: HEIGHT - BOTTOM, class: line }));
    }
    for (const [events, name] of [[run.senses, "reading"], [run.marks, "mark"]]) {
      for (let k = State.above(events.t, start) - 1; k < events.t.length; k++) {
        if (k < 0 || events.t[k] < start) continue;
        if (events.t[k] > end) break;
        if (!x.has(events.node[k])) continue;
        const px = x.get(events.node[k]), y = at.y(events.t[k]);
        const words = name === "reading" ? "reading" : events.names[events.kind[k]];
        const tick = make("line", { x1: px - 6, x2: px + 6, y1: y, y2: y, class: name },
          make("title", {}, words + " of node " + run.names[events.node[k]] + " at " + Format.time(events.t[k]) + " s"));
        svg.append(tick);
        if (name === "mark" && words !== "swap") svg.append(make("text", { x: px + 8, y: y + 4 }, words));
      }
    }
  }

  function arrow(run, row, x, at) {
    const m = run.messages, outcome = m.outcome[row], lost = outcome === State.LOST;
    const x1 = x.get(m.sender[row]), y1 = at.sent(row), whole = x.get(m.receiver[row]);
    // A lost message stops short of its receiver, between two lifelines.
    const x2 = lost ? whole - Math.sign(whole - x1) * 0.4 * x.gap : whole, y2 = lost ? y1 : at.ended(row);
    const [from, to] = cut([x1, y1], [x2, y2]), ends = to[1] === y2;
    const group = make("g", { class: "message " + State.OUTCOMES[outcome].replace(" ", "-") },
      make("title", {}, sentence(run, row)),
      make("line", { x1: from[0], y1: from[1], x2: to[0], y2: to[1] }));
    if (from[1] === y1) group.append(make("circle", { cx: x1, cy: y1, r: 2.5 }));
    if (!ends) return group;
    if (lost) {
      group.append(make("path", { d: `M${x2 - 4} ${y2 - 4}L${x2 + 4} ${y2 + 4}M${x2 - 4} ${y2 + 4}L${x2 + 4} ${y2 - 4}` }));
    } else if (outcome === State.LATE) {
      group.append(make("polygon", { points: `${x2},${y2 - 6} ${x2 + 6},${y2 + 5} ${x2 - 6},${y2 + 5}` }),
        make("text", { x: x2 + 9, y: y2 + 4 }, Format.number(m.age[row]) + " s"));
    } else if (Number.isFinite(m.ended[row])) {
      const angle = Math.atan2(y2 - y1, x2 - x1);
      const side = (turn) => `${x2 - 8 * Math.cos(angle + turn)},${y2 - 8 * Math.sin(angle + turn)}`;
      group.append(make("polygon", { points: `${x2},${y2} ${side(0.4)} ${side(-0.4)}` }));
    }
    return group;
  }

  // Beside each broadcast the nodes that lost it, also those without a lifeline here.
  function drawLosers(svg, run, drawn, x, at) {
    const m = run.messages, said = new Set();
    for (const row of drawn) {
      const key = m.sender[row] + " " + m.sent[row] + " " + m.phase[row];
      if (said.has(key)) continue;
      said.add(key);
      const names = losers(run, row);
      if (!names.length || at.sent(row) < TOP - 6) continue;
      const more = names.length > MAX_LOSERS ? " and " + (names.length - MAX_LOSERS) + " more" : "";
      svg.append(make("text", { x: x.get(m.sender[row]) + 5, y: at.sent(row) - 4, class: "hearers" },
        make("title", {}, "the broadcast of node " + run.names[m.sender[row]] + " at " + Format.time(m.sent[row]) + " s was lost by " + names.join(", ")),
        "lost by " + names.slice(0, MAX_LOSERS).join(", ") + more));
    }
  }

  // The names of the nodes that lost the broadcast which message `row` is a part of.
  function losers(run, row) {
    const m = run.messages, found = [];
    for (let k = State.firstSent(m, m.sent[row]); k < m.bySent.length && m.sent[m.bySent[k]] === m.sent[row]; k++) {
      const other = m.bySent[k];
      if (m.sender[other] === m.sender[row] && m.phase[other] === m.phase[row] && m.outcome[other] === State.LOST) found.push(m.receiver[other]);
    }
    return found.sort((a, b) => a - b).map((i) => run.names[i]);
  }

  // The part of a line that lies in the chart: messages may begin before and end after it.
  function cut([x1, y1], [x2, y2]) {
    const at = (y) => [x1 + ((x2 - x1) * (y - y1)) / (y2 - y1), y];
    const bottom = HEIGHT - BOTTOM;
    if (y1 === y2) return [[x1, y1], [x2, y2]];
    return [y1 < TOP - 6 ? at(TOP - 6) : [x1, y1], y2 > bottom ? at(bottom) : [x2, y2]];
  }

  function sentence(run, row) {
    const m = run.messages, outcome = State.OUTCOMES[m.outcome[row]];
    const age = m.outcome[row] === State.DELIVERED || m.outcome[row] === State.LATE
      ? ", age " + Format.number(m.age[row]) + " s" : "";
    return "message " + m.number[row] + " from node " + run.names[m.sender[row]] + " to node " +
      run.names[m.receiver[row]] + ", sent at " + Format.time(m.sent[row]) + " s, " + outcome + age;
  }

  function drawClock(svg, at, t, wide) {
    svg.append(make("line", { x1: LEFT - 6, x2: wide, y1: at.y(t), y2: at.y(t), class: "now" }));
  }

  // A window that shows enough messages to see what happened around t.
  function usualWindow(run, node, t) {
    const chosen = near(run, node, t), least = Math.min(16, run.messages.count);
    let width = run.horizon / 4096;
    while (width < run.horizon && rows(run, chosen, t - 0.75 * width, t + 0.25 * width).length < least) width *= 1.5;
    return Math.min(width, run.horizon) || 1;
  }

  return { draw, listen, sentence, usualWindow };
})();
