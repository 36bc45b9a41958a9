// Puts the page together: one application state, the views, and the controls that change it.
const find = (id) => document.getElementById(id);

const app = {
  time: 0, nodeId: null, axes: [0, 0], filter: "all", range: "now", lifelines: "near", picks: [],
  span: null, window: 1, playing: false, speed: 1, focus: 0, runs: [], views: [], figures: [], said: 0,

  get run() { return this.runs[this.focus]; },
  get end() { return Math.max(...this.runs.map((run) => run.horizon)); },
  get stretch() { return this.span || [0, this.end]; },

  // Seconds for which a message without travel is on show; in slots no longer than a slot.
  persist() {
    const wanted = Math.max(Clock.SHOWN * this.speed, 1e-12 * this.end);
    return this.run.period > 0 ? Math.min(wanted, this.run.period) : wanted;
  },

  nodeOf(run) {
    const found = run.index.get(this.nodeId);
    return found === undefined ? -1 : found;
  },

  filtered(run, rows) {
    const m = run.messages, node = this.nodeOf(run);
    if (this.filter === "none") return [];
    if (this.filter === "node") return rows.filter((row) => m.sender[row] === node || m.receiver[row] === node);
    if (this.filter === "trouble") return rows.filter((row) => m.outcome[row] === State.LOST || m.outcome[row] === State.LATE);
    return rows;
  },

  // What is left of the messages, in words behind their number; nothing where all are shown.
  filterWords() {
    return this.filter === "all" ? "" : " (" + find("filter").selectedOptions[0].text + ")";
  },

  setTime(t, moving) {
    this.time = Math.min(this.end, Math.max(0, t));
    schedule(moving);
  },

  advance(seconds) {
    const end = this.stretch[1];
    if (this.time + seconds >= end) { this.setTime(end); play(false); }
    else this.setTime(this.time + seconds, true);
  },

  // The stretch of time [from, to] that all figures and tracks show; null for the whole run.
  setSpan(span) {
    this.span = span && span[1] > span[0] ? span : null;
    buildFigures();
    if (!this.runs.length) return;
    find("whole").hidden = !this.span;
    find("window").disabled = Boolean(this.span); // the sequence chart shows the same stretch
    const [from, to] = this.stretch;
    for (const [name, value] of Object.entries({ min: from, max: to, step: (to - from) / 1000 })) find("scrub")[name] = String(value);
    schedule();
  },

  focusOn(run) { if (this.run !== run) focusRun(this.runs.indexOf(run)); },

  setNode(i) {
    this.nodeId = this.run.nodes[i];
    find("node").value = String(i);
    buildFigures();
    schedule();
  },
};

function play(on) {
  app.playing = on;
  const [from, to] = app.stretch;
  if (on && (app.time >= to || app.time < from)) app.time = from;
  find("play").textContent = on ? "Pause" : "Play";
  if (on) Clock.start(app);
  schedule();
}

let waiting = false, slow = 0;

// Views are drawn once a frame; text and charts, which take longer, a few times a second.
function schedule(moving) {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame((now) => {
    waiting = false;
    for (const view of app.views) view.draw(app.time);
    find("scrub").value = String(app.time);
    find("time").textContent = Format.time(app.time) + " s";
    if (!moving || !app.playing || now - slow > 200) { slow = now; drawSlowly(now); }
  });
}

function drawSlowly(now) {
  app.figures.forEach((figure) => figure.redraw());
  Tracks.draw(find("tracks"), find("tracks-note"), app);
  Sequence.draw(find("sequence"), find("sequence-note"), app.run, app);
  Why.show(find("why"), find("why-title"), app.run, app);
  if (!app.playing || now - app.said > 5000) { app.said = now; say(); }
  if (!app.playing) { fillTables(); writeMoment(); }
}

// The address of the page names the moment, the node and what else was chosen: a link to it, such
// as #t=16&node=2.
function writeMoment() {
  let moment = "#t=" + Format.time(app.time) + "&node=" + encodeURIComponent(String(app.run.names[app.nodeOf(app.run)]));
  if (app.focus) moment += "&run=" + "AB"[app.focus];
  if (app.run !== page.choices[app.focus][0]) moment += "&replica=" + app.run.replica;
  if (app.span) moment += "&from=" + Format.time(app.span[0]) + "&to=" + Format.time(app.span[1]);
  if (location.hash !== moment) try { history.replaceState(null, "", moment); } catch { /* a browser that forbids it */ }
}

// Shows the moment in the address; true if there is one. What is not of this run is passed over.
function readMoment() {
  const asked = new URLSearchParams(location.hash.slice(1)), number = (name) => Number(asked.get(name) || NaN), t = number("t");
  const r = "AB".indexOf(asked.get("run") || "A");
  if (r >= 0 && r < app.runs.length && r !== app.focus) focusRun(r);
  if (asked.has("replica")) showReplica(number("replica"));
  if (number("to") > number("from")) app.setSpan([Math.max(0, number("from")), Math.min(app.end, number("to"))]);
  const i = app.run.names.findIndex((name) => String(name) === asked.get("node"));
  if (i >= 0) app.setNode(i);
  if (Number.isFinite(t)) app.setTime(t);
  return i >= 0 || Number.isFinite(t);
}

// The state in words, for readers of the screen by ear: not more often than it can be read.
function say() {
  find("state").textContent = app.runs.map((run, r) => {
    const state = State.at(run, app.time, app.persist()), i = app.nodeOf(run);
    const rows = app.filtered(run, State.messagesAt(run, app.time, app.persist()));
    const states = rows.map((row) => State.outcomeAt(run, row, app.time));
    const of = (kind) => states.filter((found) => found === kind).length;
    const parts = [(app.runs.length > 1 ? "AB"[r] + " at " : "At ") + Format.time(app.time) + " s"];
    if (state.sample === null) parts.push("no sample yet");
    else if (i >= 0) {
      const s = state.nodes[i];
      parts.push("node " + run.names[i] + (run.truth ? " has error " + Format.number(s.error) : "") +
        (run.truth ? " and" : " has") + " square root of trace P " + Format.number(Math.sqrt(s.trace)) +
        " (sample of " + Format.time(state.sample) + " s)");
    }
    const counts = State.OUTCOMES.map((kind) => Format.count(of(kind)) + " " + kind).join(", ");
    const most = rows.length > Network.MAX_DRAWN ? ", of which " + Network.MAX_DRAWN + " are drawn" : "";
    parts.push(Format.count(rows.length) + (rows.length === 1 ? " message" : " messages") + " on show" + app.filterWords() + most + ": " + counts);
    return parts.join("; ") + ".";
  }).join(" ");
}

function fillTables() {
  if (find("table-box").open) find("table").replaceChildren(...app.runs.map(nodeTable));
  if (find("messages-box").open) find("message-table").replaceChildren(...app.runs.map(messageTable));
  Format.offerTables(find("live"));
}

function nodeTable(run, r) {
  const state = State.at(run, app.time, 0), [a, b] = app.axes, n = run.n;
  const parts = a === b ? [a] : [a, b], inUnit = page.unit === "units of the state" ? "" : " (" + page.unit + ")";
  const header = ["node", ...parts.flatMap((c) => [run.states[c].replace(/^x(?=\d)/, "xhat"), "95 % +-"]), "trace P", "error" + inUnit, "NEES", "age of information (s)"];
  const rows = state.nodes.map((s, i) => [run.names[i],
    ...parts.flatMap((c) => [Format.number(s.xhat[c]), Format.number(run.scale.interval * Math.sqrt(State.variance(s.P, n, c, c)))]),
    Format.number(s.trace), Format.number(s.error), Format.number(s.nees), Format.number(s.age)]);
  const truth = state.x ? "; truth " + parts.map((c) => run.states[c] + " = " + Format.number(state.x[c])).join(", ") : "; no truth that all share is known";
  const name = app.runs.length > 1 ? "AB"[r] + ": nodes" : "Nodes";
  return Format.table(name + " at the sample of " + Format.time(state.sample ?? NaN) + " s" + truth, header, rows);
}

function messageTable(run, r) {
  const rows = app.filtered(run, State.messagesAt(run, app.time, app.persist())).slice(0, 200).map((row) => {
    const m = run.messages;
    return [run.names[m.sender[row]], run.names[m.receiver[row]], m.number[row], Format.time(m.sent[row]),
      State.outcomeAt(run, row, app.time), m.outcome[row] === State.LOST ? "-" : Format.number(m.age[row])];
  });
  const name = app.runs.length > 1 ? "AB"[r] + ": messages" : "Messages";
  return Format.table(name + " on show at " + Format.time(app.time) + " s (at most 200)", ["from", "to", "number", "sent", "state", "age"], rows);
}

function options(select, entries) {
  select.replaceChildren(...entries.map(([value, words]) => Format.element("option", { value }, words)));
}

// Networks side by side, and estimates: what is compared has the same scales.
function buildViews() {
  const name = (run, r) => (app.runs.length > 1 ? "AB"[r] + ", " + run.label + ": " : "");
  const about = (run) => (run.truth ? "each node stands for the truth, its ellipse lies where its error puts it" : "ellipses show how certain a node is; there is no truth") + ". Colour: " + (run.truth ? "error" : "square root of trace P");
  app.views = [];
  find("views").replaceChildren(
    ...app.runs.map((run, r) => viewBox(run, name(run, r) + "Network:", about(run), Network.view, true)),
    ...app.runs.map((run, r) => viewBox(run, name(run, r) + "Estimates:", "of every node at the last sample, with 95 % by its P" + (run.truth ? ", beside the truth" : ""), Estimates.view, false)),
  );
}

function viewBox(run, title, about, make, pick) {
  const canvas = Format.element("canvas", { role: "img", "aria-label": title + ": " + about + ". The tables below have the same in numbers." });
  const box = Format.element("div", { class: "view", tabindex: "0", role: "group", "aria-label": title + ", keys move the clock" }, canvas);
  const view = make(run, canvas, app);
  app.views.push(view);
  box.addEventListener("keydown", keys);
  if (pick) canvas.addEventListener("click", (event) => {
    const edge = canvas.getBoundingClientRect(), i = view.hit(event.clientX - edge.left, event.clientY - edge.top);
    if (i >= 0) { focusRun(app.runs.indexOf(run)); app.setNode(i); find("why-title").scrollIntoView({ block: "nearest" }); }
  });
  return Format.element("figure", { class: "motion" }, Format.element("figcaption", {}, Format.element("strong", {}, title), " ", about), box);
}

function step(way) {
  const t = app.run.samples.t, k = State.sampleAt(app.run, app.time);
  const next = way > 0 ? k + 1 : app.time > t[k] ? k : k - 1;
  app.setTime(next < 0 ? 0 : next >= t.length ? app.end : t[next]);
}

function nextMessage() {
  const m = app.run.messages;
  for (let k = 0; k < m.bySent.length; k++) {
    const row = m.bySent[k];
    if (m.sent[row] > app.time && app.filtered(app.run, [row]).length) return app.setTime(m.sent[row]);
  }
}

function toWorst() {
  const worst = app.run.worst;
  if (!worst) return;
  app.setNode(app.run.index.get(worst.node));
  app.setTime(worst.time);
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const far = event.shiftKey, tenth = app.end / 10, last = app.run.N;
  const i = app.nodeOf(app.run);
  const actions = {
    " ": () => play(!app.playing), m: nextMessage, w: toWorst,
    ArrowLeft: () => (far ? app.setTime(app.time - tenth) : step(-1)),
    ArrowRight: () => (far ? app.setTime(app.time + tenth) : step(1)),
    Home: () => app.setTime(app.stretch[0]), End: () => app.setTime(app.stretch[1]),
    ArrowUp: () => app.setNode((i + 1) % last), ArrowDown: () => app.setNode((i - 1 + last) % last),
  };
  const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (action) { event.preventDefault(); action(); }
}

function focusRun(r) {
  app.focus = r;
  find("run").value = String(r);
  const run = app.run;
  options(find("node"), run.names.map((node, i) => [String(i), String(node) + (run.sensing[i] ? " (sensor)" : "")]));
  options(find("replica"), page.choices[r].map((one) => [String(one.replica), one.words]));
  find("replica").value = String(run.replica);
  find("replica-choice").hidden = page.choices[r].length < 2;
  if (app.nodeOf(run) < 0) app.nodeId = run.nodes[0];
  find("node").value = String(app.nodeOf(run));
  app.picks = run.nodes.slice(0, 6).map((_, i) => i);
  buildPicks(run);
  schedule();
}

// Another recorded run of the ensemble moves in the place of the one in focus.
function showReplica(number) {
  const found = page.choices[app.focus].find((run) => run.replica === number);
  if (!found || found === app.run) return;
  app.runs[app.focus] = found;
  focusRun(app.focus);
  buildViews();
  buildFigures();
}

function buildPicks(run) {
  find("picks").replaceChildren(...run.names.map((node, i) => {
    const box = Format.element("input", { type: "checkbox" });
    box.checked = app.picks.includes(i);
    box.addEventListener("change", () => {
      app.picks = box.checked ? [...app.picks, i].sort((a, b) => a - b) : app.picks.filter((k) => k !== i);
      app.lifelines = find("lifelines").value = "picked";
      schedule();
    });
    return Format.element("label", {}, box, " " + node);
  }));
}

function buildFigures() {
  if (!find("curves")) return;
  app.figures = Figures.all(app, page).map((figure) => Curves.figure(app, figure));
  find("curves").replaceChildren(...app.figures.map((figure) => figure.whole));
  app.figures.forEach((figure) => figure.build());
}

function choose(id, entries, value, change) {
  const select = find(id);
  if (entries) options(select, entries);
  select.value = String(value);
  select.addEventListener("change", () => { change(select.value); schedule(); });
}

// So many messages that they hide each other: begin with those of the node.
function usualFilter() {
  return app.runs.some((run) => {
    const rate = run.totals.messages / Math.max(run.horizon, 1e-300);
    return rate * app.persist() > 3 * run.N + 10;
  }) ? "node" : "all";
}

function setUpControls() {
  const run = app.run, least = Math.min(...app.runs.map((one) => one.n));
  const speeds = Clock.speeds(app.end);
  app.speed = Clock.usual(app.end, run.period);
  app.filter = usualFilter();
  app.axes = run.axes.map((c) => Math.min(c, least - 1));
  app.window = Sequence.usualWindow(run, app.nodeOf(run), app.time);
  const parts = Array.from({ length: least }, (_, c) => [String(c), run.states[c]]);
  choose("speed", speeds.map((s) => [String(s), Format.number(s) + " s per s"]), app.speed, (v) => { app.speed = Number(v); });
  choose("filter", null, app.filter, (v) => { app.filter = v; });
  choose("axis-x", parts, app.axes[0], (v) => { app.axes[0] = Number(v); });
  choose("axis-y", parts, app.axes[1], (v) => { app.axes[1] = Number(v); });
  choose("range", null, app.range, (v) => { app.range = v; });
  choose("lifelines", null, app.lifelines, (v) => { app.lifelines = v; });
  const windows = [0.1, 0.3, 1, 3, 10].map((factor) => Number((app.window * factor).toPrecision(2)));
  app.window = windows[2];
  choose("window", windows.map((w) => [String(w), Format.number(w) + " s"]), app.window, (v) => { app.window = Number(v); });
  choose("run", app.runs.map((one, r) => [String(r), "AB"[r] + ", " + one.label]), 0, (v) => focusRun(Number(v)));
  find("run-choice").hidden = app.runs.length < 2;
  find("node").addEventListener("change", () => app.setNode(Number(find("node").value)));
  find("replica").addEventListener("change", () => showReplica(Number(find("replica").value)));
  find("scrub").addEventListener("input", () => app.setTime(Number(find("scrub").value)));
  find("play").addEventListener("click", () => play(!app.playing));
  find("back").addEventListener("click", () => step(-1));
  find("forward").addEventListener("click", () => step(1));
  find("next").addEventListener("click", nextMessage);
  find("worst").addEventListener("click", toWorst);
  find("whole").addEventListener("click", () => app.setSpan(null));
  window.addEventListener("hashchange", readMoment);
  for (const id of ["table-box", "messages-box"]) find(id).addEventListener("toggle", fillTables);
}

function startLive() {
  find("live-body").hidden = false;
  const worst = app.runs[0].worst;
  app.nodeId = worst ? worst.node : app.runs[0].nodes[0];
  app.time = worst ? worst.time : 0;
  setUpControls();
  focusRun(0);
  buildViews();
  Tracks.listen(find("tracks"), app);
  Sequence.listen(find("sequence"), app);
  app.setSpan(null);
  readMoment();
}

const page = JSON.parse(find("page-data").textContent);

async function start() {
  Theme.read();
  if (page.runs.length && typeof DecompressionStream === "undefined") {
    find("live-problem").hidden = false;
    find("live-problem").textContent = "This browser is too old for the live views and the curves; the tables below say the same.";
    page.runs = [];
  }
  if (page.runs.length) {
    const bytesOf = await Decode.columns(find("page-columns").textContent, page.sizes);
    page.choices = page.runs.map((data, r) => [data, ...page.replicas[r]].map((one) => Decode.run(one, bytesOf)));
    app.runs = page.runs = page.choices.map((runs) => runs[0]);
    startLive();
  } else {
    const known = page.ensembles.find(Boolean);
    app.nodeId = known ? Number(Object.keys(known.nodes)[0]) : null;
    app.setTime = () => {};
  }
  buildFigures();
  Format.offerTables(document);
  const redraw = () => {
    buildFigures();
    if (app.runs.length) schedule();
  };
  Theme.watch(redraw);
  if (app.runs.length) schedule();
  window.netkf = {
    state: (t, persist, r) => State.at(app.runs[r || 0], t, persist ?? app.persist()),
    why: (node, t, r) => Why.explain(app.runs[r || 0], app.runs[r || 0].index.get(node), t),
    format: Format.number, time: () => app.time, app,
  };
  document.documentElement.dataset.ready = "true";
}

start();
