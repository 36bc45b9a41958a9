// Why a node knew what it knew at a time: a search backwards through the messages of the page.
const Why = (() => {
  const MAX_LISTED = 40;

  // What a node had heard over one link by time t: the newest delivered message by when it was
  // sent, and those sent after it.
  function heard(run, link, t) {
    const m = run.messages;
    let newest = -1;
    for (let row = link.from; row < link.to; row++) {
      if (!known(run, m.sent[row], t)) break;
      if (m.outcome[row] === State.DELIVERED && known(run, m.ended[row], t)) newest = row;
    }
    const since = newest < 0 ? -Infinity : m.sent[newest], missing = [];
    for (let row = newest < 0 ? link.from : newest + 1; row < link.to && known(run, m.sent[row], t); row++) {
      missing.push(row);
    }
    return { sender: link.sender, newest, sent: since, missing };
  }

  // True if the sample that is shown at t knows of what happened at `time`: samples of slots are
  // either predictions, with which the slot begins, or know of the whole slot.
  function known(run, time, t) {
    if (run.knowledge === "before") return time < t;
    if (run.knowledge === "slot") return time < (Math.floor(t / run.period + 1e-6) + 1) * run.period * (1 - 1e-12);
    return time <= t;
  }

  // Stretches of time in which what a node learned can have reached `node` by t, as
  // { node, from, to, way }: the node itself first, later stretches before earlier ones.
  function stretches(run, node, t) {
    const own = { node, from: -Infinity, to: t, way: [node], last: true };
    if (run.flow === "pooled") return run.nodes.map((_, i) => ({ ...own, node: i, way: [i] }));
    if (run.flow === "readings") return [own, ...direct(run, node, t)];
    return run.flow === "swap" ? swaps(run, node, t) : combined(run, node, t);
  }

  // Messages that carry the reading of their instant, which nobody passes on.
  function direct(run, node, t) {
    const m = run.messages;
    return run.messages.into[node].map((link) => heard(run, link, t)).filter((link) => link.newest >= 0)
      .map((link) => ({ node: link.sender, from: link.sent, to: m.sent[link.newest], way: [link.sender, node] }));
  }

  // With each swap a node goes on with what the other knew: one chain backwards.
  function swaps(run, node, t) {
    const m = run.messages, found = [], way = [node];
    let at = node, to = t, last = true;
    for (let hops = 0; hops <= m.count; hops++) {
      let row = -1;
      for (const link of m.into[at]) {
        for (let k = link.from; k < link.to; k++) {
          const before = last ? known(run, m.ended[k], t) : m.ended[k] < to;
          if (m.outcome[k] !== State.DELIVERED || !before) continue;
          if (row < 0 || m.ended[k] >= m.ended[row]) row = k;
        }
      }
      found.push({ node: at, from: row < 0 ? -Infinity : m.ended[row], to, way: way.slice().reverse(), last });
      if (row < 0) break;
      at = m.sender[row];
      to = m.sent[row];
      last = false;
      way.push(at);
    }
    return found;
  }

  // Nodes that combine what they hear: the latest moment of each of which anything can have reached
  // `node` by t. Messages are taken from the last arrival to the first, so a node's moment is final
  // before any message into it is looked at. At one instant senders send before anybody receives,
  // so a relay must have heard strictly before it sends.
  function combined(run, node, t) {
    const m = run.messages, moments = new Array(run.N).fill(null);
    moments[node] = { t, row: -1 };
    for (const row of arrivals(run)) {
      const to = moments[m.receiver[row]];
      if (to === null || m.sender[row] === node) continue;
      if (!(m.receiver[row] === node ? known(run, m.ended[row], t) : m.ended[row] < to.t)) continue;
      const from = moments[m.sender[row]];
      if (from === null || m.sent[row] > from.t) moments[m.sender[row]] = { t: m.sent[row], row };
    }
    const found = [];
    moments.forEach((moment, i) => {
      if (moment !== null) found.push({ node: i, from: -Infinity, to: moment.t, way: way(run, moments, i), last: i === node });
    });
    return found;
  }

  function arrivals(run) {
    const m = run.messages;
    if (!m.byArrival) {
      const rows = Array.from(m.sent.keys()).filter((row) => m.outcome[row] === State.DELIVERED);
      m.byArrival = Uint32Array.from(rows);
      m.byArrival.sort((a, b) => m.ended[b] - m.ended[a] || m.sent[b] - m.sent[a]);
    }
    return m.byArrival;
  }

  // For each sensing node its newest reading that can have reached the node, and by which way.
  function readings(run, node, t) {
    const found = new Map();
    for (const stretch of stretches(run, node, t)) {
      if (!run.sensing[stretch.node]) continue;
      const at = newest(run, stretch, t), best = found.get(stretch.node);
      if (Number.isFinite(at) && !(best && best.at >= at)) found.set(stretch.node, { node: stretch.node, at, way: stretch.way });
    }
    return run.nodes.map((_, i) => i).filter((i) => run.sensing[i])
      .map((i) => found.get(i) || { node: i, at: NaN, way: [] });
  }

  // The newest reading in a stretch. Continuous readings are used up to its very end.
  function newest(run, stretch, t) {
    if (run.continuous.includes(run.nodes[stretch.node])) return stretch.to;
    const times = run.readings[stretch.node];
    let k = State.above(times, stretch.to + (stretch.last ? run.period : 0)) - 1;
    while (stretch.last && k >= 0 && !known(run, times[k], t)) k--;
    if (k < 0 || times[k] < stretch.from) return NaN;
    return run.period > 0 ? Math.floor(times[k] / run.period + 1e-6) * run.period : times[k];
  }

  function way(run, moments, from) {
    const passed = [from];
    for (let i = from; moments[i].row >= 0 && passed.length <= run.N; ) {
      i = run.messages.receiver[moments[i].row];
      passed.push(i);
    }
    return passed;
  }

  function explain(run, node, t) {
    const links = run.messages.into[node].map((link) => heard(run, link, t));
    links.sort((a, b) => a.sent - b.sent);
    return { links, readings: readings(run, node, t), complete: complete(run, links, t) };
  }

  // A page that holds only some messages outside of a span answers for the inside of it.
  function complete(run, links, t) {
    const m = run.messages;
    if (m.step === 1) return true;
    return t >= m.start && t <= m.end && links.every((link) => link.sent >= m.start);
  }

  function show(box, title, run, app) {
    const node = app.nodeOf(run), t = app.time, k = State.sampleAt(run, t);
    title.textContent = "Why: node " + run.names[node] + " at " + Format.time(t) + " s";
    const found = explain(run, node, t), parts = [lead(run, node, k, found, t)];
    if (!found.complete) parts.push(Format.element("p", { class: "note" }, thinned(run)));
    if (found.links.length) parts.push(linkTable(run, found.links, t));
    if (found.readings.length) parts.push(readingTable(run, node, found.readings, t));
    parts.push(lostList(run, found.links));
    parts.push(Format.element("p", {}, "What it would have been had these messages come, replayed: ",
      Format.element("code", {}, "netkf why " + quoted(run.label) + " --node " + quoted(String(run.names[node])) + " --at " + Format.time(t) + (run.replica ? " --replica " + run.replica : ""))));
    box.replaceChildren(...parts);
  }

  function quoted(label) {
    return /^[\w./-]+$/.test(label) ? label : "'" + label.replace(/'/g, "'\\''") + "'";
  }

  function thinned(run) {
    const m = run.messages;
    return "The page holds all messages from " + Format.time(m.start) + " to " + Format.time(m.end) +
      " s only, and this answer reaches outside of it: it may lack messages. The command below knows all.";
  }

  function lead(run, node, k, found, t) {
    const parts = [];
    if (k >= 0) {
      const s = State.sampleOf(run, k, node);
      parts.push("Sampled at " + Format.time(run.samples.t[k]) + " s:");
      if (run.truth) parts.push("error " + Format.number(s.error) + ",");
      parts.push("square root of trace P " + Format.number(Math.sqrt(s.trace)) + ".");
      if (Number.isFinite(s.nees)) parts.push("NEES " + Format.number(s.nees) + ", expected " + run.samples.sizes[node] + " where P is exact.");
    }
    const down = run.down.find(([i, begin, end]) => i === node && begin <= t && t < end);
    if (down) parts.push("It was down, since " + Format.time(down[1]) + " s.");
    const lost = found.links.reduce((sum, link) => sum + bad(run, link).length, 0);
    const oldest = found.links[0];
    if (oldest) {
      const silent = found.links.filter((link) => link.newest < 0).length;
      const others = silent > 1 ? " and " + (silent - 1) + (silent > 2 ? " others" : " other") : "";
      parts.push(silent ? "It had never heard node " + run.names[oldest.sender] + others + "."
        : "Oldest link: node " + run.names[oldest.sender] + ", heard as of " + Format.number(Math.max(0, t - oldest.sent)) + " s before.");
      parts.push(lost + (lost === 1 ? " message" : " messages") + " to it lost or late since it last heard each sender.");
    } else parts.push("No message was ever sent to it.");
    if (run.knowledge === "slot") parts.push("A sample knows of all rounds of the slot that begins with it.");
    return Format.element("p", { class: "state" }, parts.join(" "));
  }

  function bad(run, link) {
    return link.missing.filter((row) => [State.LOST, State.LATE].includes(run.messages.outcome[row]));
  }

  function linkTable(run, links, t) {
    const m = run.messages;
    const rows = links.map((link) => {
      const kinds = link.missing.map((row) => m.outcome[row]);
      const of = (outcome) => kinds.filter((kind) => kind === outcome).length;
      const none = link.newest < 0;
      return ["node " + run.names[link.sender], none ? "never" : Format.time(link.sent),
        none ? "-" : Format.time(m.ended[link.newest]), none ? "-" : Format.number(Math.max(0, t - link.sent)),
        of(State.LOST), of(State.LATE), kinds.length - of(State.LOST) - of(State.LATE)];
    });
    return Format.table("What it had heard, oldest first (seconds)",
      ["from", "newest sent at", "arrived at", "age", "lost since", "late since", "on the way"], rows);
  }

  function readingTable(run, node, readings, t) {
    const came = readings.filter((reading) => Number.isFinite(reading.at));
    const none = readings.filter((reading) => !Number.isFinite(reading.at)).map((reading) => run.names[reading.node]);
    const rows = came.map((reading) => ["node " + run.names[reading.node], Format.time(reading.at),
      Format.number(Math.max(0, t - reading.at)),
      reading.node === node ? "its own sensor" : reading.way.map((i) => run.names[i]).join(" \u2192 ")]);
    const parts = rows.length ? [Format.table("Newest readings that can have reached it (seconds)",
      ["sensor of", "read at", "age", "way"], rows)] : [];
    if (none.length) parts.push(Format.element("p", {}, "No reading of node " + none.join(", ") + " can have reached it yet."));
    return Format.element("div", {}, ...parts);
  }

  function lostList(run, links) {
    const rows = links.flatMap((link) => bad(run, link)).sort((a, b) => run.messages.sent[b] - run.messages.sent[a]);
    const items = rows.slice(0, MAX_LISTED).map((row) => Format.element("li", {}, Sequence.sentence(run, row)));
    if (rows.length > MAX_LISTED) items.push(Format.element("li", {}, "and " + (rows.length - MAX_LISTED) + " more"));
    if (!rows.length) return Format.element("p", {}, "No lost or late message stands between it and those it hears.");
    return Format.element("details", {}, Format.element("summary", {}, rows.length + " lost or late messages in between"),
      Format.element("ul", {}, ...items));
  }

  return { heard, readings, explain, show };
})();
