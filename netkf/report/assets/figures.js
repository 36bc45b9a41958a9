// The figures of a page: which curves there are. How they look is in curves.js.
const Figures = (() => {
  // One colour is one run in every figure of two runs: what is claimed is dashed, bounds are dotted.
  const coloured = (runs, r, alone) => (runs.length > 1 ? page.series[r] : alone);
  const root = (values) => Array.from(values, (v) => Math.sqrt(v));

  const letter = (runs, r) => (runs.length > 1 ? "AB"[r] + ": " : "");
  const column = (run, values, i) => Array.from({ length: run.samples.count }, (_, k) => values[k * run.N + i]);

  // Over the nodes at each sample: root of the mean square, smallest and largest root.
  function overNodes(run, values) {
    const all = { rms: [], low: [], high: [] };
    for (let k = 0; k < run.samples.count; k++) {
      const row = Array.from(values.subarray(k * run.N, (k + 1) * run.N));
      all.rms.push(Math.sqrt(row.reduce((a, b) => a + b, 0) / run.N));
      all.low.push(Math.sqrt(Math.min(...row)));
      all.high.push(Math.sqrt(Math.max(...row)));
    }
    return all;
  }

  function traces(run) {
    if (!run.traces) {
      run.traces = new Float64Array(run.samples.count * run.N);
      for (let k = 0; k < run.samples.count; k++) {
        for (let i = 0; i < run.N; i++) run.traces[k * run.N + i] = State.sampleOf(run, k, i).trace;
      }
    }
    return run.traces;
  }

  // What can be seen of errors without truth: how far a node is from what all nodes say on average.
  function apart(run, i) {
    const n = run.n, xhat = run.samples.xhat;
    return Array.from({ length: run.samples.count }, (_, k) => {
      let sum = 0;
      for (let c = 0; c < n; c++) {
        let mean = 0;
        for (let j = 0; j < run.N; j++) mean += xhat[(k * run.N + j) * n + c] / run.N;
        sum += (xhat[(k * run.N + i) * n + c] - mean) ** 2;
      }
      return Math.sqrt(sum);
    });
  }

  // The node in focus by its name, in the r-th run, whose live views the page may not have.
  function nodeName(app, r) {
    const row = (page.summaries[r] || []).find((found) => found.node === app.nodeId);
    return row ? row.name : app.nodeId;
  }

  // How the runs of an ensemble spread about the one that moves.
  function spread(app, r, name) {
    const found = page.ensembles[r], entry = found && found.spread && found.spread[String(app.nodeId)];
    if (!entry) return [];
    const [y, low, high] = entry;
    return [{ label: name + "error of node " + nodeName(app, r) + ", median of all runs; shaded: 90 % of them", x: found.times, y, low, high, colour: coloured(page.runs, r, "purple"), width: 1, dash: "dotted" }];
  }

  // Which run of an ensemble moves.
  const which = (runs) => (page.ensembles.some(Boolean) ? ", replica " + runs.map((run) => run.replica).join(" and ") : "");

  function errors(app, runs) {
    const series = [], lines = [];
    runs.forEach((run, r) => {
      const i = app.nodeOf(run), name = letter(runs, r), x = run.samples.t, colour = page.series[r];
      series.push(...spread(app, r, name));
      if (run.truth) {
        const all = overNodes(run, run.samples.sq_error);
        // Beside the runs of two ensembles those of all nodes would hide the curves.
        if (runs.length === 1 || !page.ensembles[r]) series.push({ label: name + "all nodes, root mean square; shaded: smallest to largest", x, y: all.rms, low: all.low, high: all.high, colour, width: 1, dash: "dotted" });
        if (i >= 0) series.push({ label: name + "error of node " + run.names[i], x, y: root(column(run, run.samples.sq_error, i)), colour, width: 2.5 });
      } else {
        const all = overNodes(run, traces(run));
        series.push({ label: name + "square root of trace P, all nodes; shaded: smallest to largest", x, y: all.rms, low: all.low, high: all.high, colour, width: 1, dash: "dotted" });
      }
      if (!run.truth && i >= 0 && run.samples.one_state) series.push({ label: name + "distance of node " + run.names[i] + "'s estimate from the mean of all nodes'", x, y: apart(run, i), colour, width: 2.5 });
      if (i >= 0) series.push({ label: name + "square root of trace P of node " + run.names[i], x, y: root(column(run, traces(run), i)), colour: coloured(runs, r, "green"), width: 2, dash: "dashed" });
      if (i >= 0 && run.samples.bound) series.push({ label: name + "square root of the bound H(12) on the mean of trace P", x, y: root(column(run, run.samples.bound, i)), colour: coloured(runs, r, "ink"), width: 2, dash: runs.length > 1 ? "dotted" : "solid" });
    });
    for (const [label, value] of Object.entries(runs[0].limits)) lines.push({ label: label + ", square root:", y: Math.sqrt(value), colour: "purple", dash: lines.length ? "dotted" : "dashed" });
    const truth = runs.some((run) => run.truth);
    const bound = runs.some((run) => run.samples.bound);
    return { title: truth ? (bound ? "Error and bound" : "Error and uncertainty") : "Uncertainty and disagreement", unit: (truth ? "|x - xhat|, " : "") + page.unit, timed: true, series, lines,
      note: bound ? "One run" + which(runs) + ": the bound is about the mean over runs." : truth ? "P is the covariance that the filter claims" + which(runs) + "." : "Without truth there is no error." };
  }

  function nees(app, runs) {
    const series = [];
    runs.forEach((run, r) => {
      const i = app.nodeOf(run);
      if (!run.truth || i < 0) return;
      series.push({ label: letter(runs, r) + "NEES of node " + run.names[i], x: run.samples.t, y: column(run, run.samples.nees, i), colour: page.series[r], width: 1.8, dash: r ? "dashed" : "solid" });
      // Of each block that the node estimates, beside that of all of them.
      run.samples.blocks.forEach(([node, name], k) => {
        const y = run.samples["nees_of_block_" + k];
        if (node === i && y) series.push({ label: letter(runs, r) + name + " by node " + run.names[i], x: run.samples.t, y: Array.from(y), colour: page.series[r], width: 0.8, dash: "dotted" });
      });
    });
    if (!series.some((s) => s.y.some(Number.isFinite))) return null;
    const { sizes, nees_intervals } = runs[0].samples, i = Math.max(0, app.nodeOf(runs[0]));
    return { title: "Does P fit the error?", unit: "NEES", timed: true, series, band: nees_intervals[i],
      lines: [{ label: "expected where P is exact:", y: sizes[i], colour: "green", dash: "dashed" }], note: "Squared error in units of P" + (page.states && "; " + page.states) + "." };
  }

  const PARTS = 30; // parts of a run over which squared innovations are averaged

  // The readings that count for a node: its own, or those that one filter uses together.
  function readingsOf(run, i) {
    const v = run.innovations;
    return !v ? null : v.means[i] ? i : v.means[-1] ? -1 : null;
  }

  function innovations(app, runs) {
    const series = [], lines = [];
    runs.forEach((run, r) => {
      const i = readingsOf(run, app.nodeOf(run)), v = run.innovations;
      if (i === null) return;
      const rows = Array.from(v.t.keys()).filter((k) => v.node[k] === i), x = rows.map((k) => v.t[k]);
      const wide = run.horizon / PARTS, parts = new Map();
      rows.forEach((k) => {
        const at = Math.min(PARTS - 1, Math.floor(v.t[k] / wide)), [sum, count] = parts.get(at) || [0, 0];
        parts.set(at, [sum + v.nis[k], count + 1]);
      });
      const at = [...parts.keys()].sort((a, b) => a - b), name = letter(runs, r), [mean, low, high] = v.means[i];
      const read = run.read.at(i), whose = (i < 0 ? "of all nodes together" : "of node " + run.names[i]) + (read && ": " + read);
      series.push({ label: name + "each reading " + whose, x, y: rows.map((k) => v.nis[k]), colour: page.series[r], dots: true });
      series.push({ label: name + "mean of each " + Format.number(wide) + " s", x: at.map((k) => (k + 0.5) * wide), y: at.map((k) => parts.get(k)[0] / parts.get(k)[1]), colour: coloured(runs, r, "ink"), width: 2 });
      lines.push({ label: name + "mean of all (where P is exact " + Format.number(low) + " .. " + Format.number(high) + "):", y: mean, colour: coloured(runs, r, "purple"), dash: "dotted" });
    });
    if (!series.length) return null;
    lines.push({ label: "expected where P is exact:", y: 1, colour: "green", dash: "dashed" });
    return { title: "Do readings fit their predictions?", unit: "NIS / rows of a reading", timed: true, series, lines,
      note: "Squared innovations, readings minus predictions, in units of their covariance; by a replay of the run." };
  }

  function whiteness(app, runs) {
    const series = [];
    let band = null;
    runs.forEach((run, r) => {
      const i = readingsOf(run, app.nodeOf(run)), found = i === null ? null : run.innovations.correlations[i];
      if (!found) return;
      band = band || [-found.band, found.band];
      series.push({ label: letter(runs, r) + (i < 0 ? "all readings" : "readings of node " + run.names[i]) + (found.label && ": " + found.label), x: found.values.map((_, k) => k + 1), y: found.values, colour: page.series[r], points: true, dash: r ? "dashed" : "solid" });
    });
    return series.length ? { title: "Are innovations white?", unit: "autocorrelation", xlabel: "lag (readings)", series, band, note: "Beyond the band a prediction misses what earlier readings said." } : null;
  }

  function ages(app, runs) {
    const series = [];
    runs.forEach((run, r) => {
      const i = app.nodeOf(run), x = run.samples.t;
      const mean = Array.from({ length: run.samples.count }, (_, k) => {
        const row = Array.from(run.samples.age.subarray(k * run.N, (k + 1) * run.N)).filter(Number.isFinite);
        return row.length ? row.reduce((a, b) => a + b, 0) / row.length : NaN;
      });
      series.push({ label: letter(runs, r) + "mean of all nodes", x, y: mean, colour: page.series[r], width: 1, dash: "dotted" });
      if (i >= 0) series.push({ label: letter(runs, r) + "node " + run.names[i], x, y: column(run, run.samples.age, i), colour: page.series[r], width: 2 });
    });
    if (!series.some((s) => s.y.some(Number.isFinite))) return null;
    return { title: "Age of information", unit: "seconds", timed: true, series,
      note: "Time since the newest message heard was sent, averaged over the links into a node." };
  }

  function traffic(app, runs) {
    const dashes = { delivered: "solid", lost: "dashed", late: "dotted", "under way": "dotted" };
    const colours = { delivered: "blue", lost: "red", late: "orange", "under way": "purple" };
    const series = [];
    runs.forEach((run, r) => {
      for (const [kind, dash] of Object.entries(dashes)) {
        const colour = coloured(runs, r, colours[kind]);
        const y = run.traffic[kind], wide = run.horizon / y.length;
        if (!y.some(Boolean)) continue;
        series.push({ label: letter(runs, r) + kind, x: y.map((_, k) => (k + 0.5) * wide), y, colour, dash, width: 1.8 });
      }
    });
    if (!series.length) return null;
    const wide = Format.number(runs[0].horizon / runs[0].traffic.lost.length);
    return { title: "Traffic", unit: "messages per " + wide + " s", timed: true, series, note: "All messages, by when they were sent." };
  }

  // Nodes have no order: dots with error bars, those of two runs beside each other.
  function averages(app, summaries) {
    const series = [], many = summaries.length > 1, names = new Map();
    summaries.forEach((rows, r) => {
      if (!rows) return;
      for (const row of rows) if (names.get(row.node) !== row.name) names.set(row.node, names.has(row.node) ? row.node : row.name);
      const x = rows.map((row) => row.node + (many ? 0.24 * r - 0.12 : 0)), name = letter(summaries, r);
      const of = (key) => rows.map((row) => row[key]);
      const wide = (key, side) => rows.map((row) => (row[key + "_se"] ? row[key] + side * 2 * row[key + "_se"] : row[key]));
      if (of("rms_error").some(Number.isFinite)) {
        const bars = rows.some((row) => row.rms_error_se) ? { low: wide("rms_error", -1), high: wide("rms_error", 1) } : {};
        series.push({ label: name + "RMS error" + (bars.low ? ", bars: two standard errors" : ""), x, y: of("rms_error"), ...bars, colour: page.series[r], mark: "dot" });
      }
      series.push({ label: name + "square root of mean trace P", x, y: root(of("mean_trace")), colour: coloured(summaries, r, "green"), mark: "ring" });
      if (of("bound").some(Number.isFinite)) series.push({ label: name + "square root of its bound", x, y: root(of("bound").map((v) => v ?? NaN)), colour: coloured(summaries, r, "ink"), mark: "tick" });
    });
    return series.length ? { title: "Averages per node", unit: page.unit, xlabel: "node", names, series, note: "Root mean squares over time; the numbers stand in the table." } : null;
  }

  function ensemble(app, ensembles) {
    const series = [];
    ensembles.forEach((found, r) => {
      const entry = found && found.nodes[String(app.nodeId)];
      if (!entry) return;
      const name = letter(ensembles, r), x = found.times;
      const add = (label, [y, low, high], colour, dash) => series.push({ label: name + label, x, y, low, high, colour, dash, width: 2 });
      if (entry.square[0].some(Number.isFinite)) add("mean squared error of node " + nodeName(app, r), entry.square, page.series[r], "solid");
      add("mean trace P of node " + nodeName(app, r), entry.trace, coloured(ensembles, r, "green"), "dashed");
      if (entry.bound) series.push({ label: name + "bound H(12)", x, y: entry.bound, colour: coloured(ensembles, r, "ink"), dash: "dotted", width: 2 });
    });
    return series.length ? { title: "Mean over the runs", unit: "squared " + page.unit, timed: true, series, note: "Shaded: at least two standard errors on each side." } : null;
  }

  function ensembleNees(app, ensembles) {
    const series = [];
    ensembles.forEach((found, r) => {
      const entry = found && found.nodes[String(app.nodeId)];
      if (!entry || !entry.nees[0].some(Number.isFinite)) return;
      const [y, low, high] = entry.nees;
      series.push({ label: letter(ensembles, r) + "mean NEES of node " + nodeName(app, r), x: found.times, y, low, high, colour: page.series[r], width: 2 });
    });
    const known = ensembles.find((found) => found && found.nodes[String(app.nodeId)]);
    return series.length ? { title: "Does P fit the error, on average?", unit: "mean NEES", timed: true, series, band: known.nodes[String(app.nodeId)].nees_interval, note: "Shaded in the colour of a curve: two standard errors." } : null;
  }

  function difference(app, found) {
    const entry = found && found.nodes[String(app.nodeId)];
    if (!entry) return null;
    const [y, low, high] = entry, x = found.times;
    const sure = y.map((v, k) => (low[k] > 0 || high[k] < 0 ? v : NaN));
    const series = [{ label: "B - A, mean squared error of node " + nodeName(app, 0) + "; shaded: interval", x, y, low, high, colour: "purple" }];
    if (sure.some(Number.isFinite)) series.push({ label: "certain: the interval leaves out 0", x, y: sure, colour: "ink", points: true, width: 3 });
    const title = sure.some(Number.isFinite) ? "Where they differ for certain" : "The difference over time, nowhere certain";
    return { title, unit: "squared " + page.unit, timed: true, series, lines: [{ label: "no difference", y: 0, colour: "ink", dash: "dotted" }],
      note: "All intervals, of all nodes and times, hold together with probability " + found.confidence + "." };
  }

  // The look of the k-th of many curves, whose colour is that of figures/names.py.
  const DASHES = ["solid", "dashed", "dashdot"];
  const look = (k) => ({ colour: page.series[k % page.series.length], dash: DASHES[(k + Math.floor(k / page.series.length)) % 3], width: 2 });
  const APART = 10; // as LOG_LEVELS of figures/style.py

  function median(values) {
    const known = values.filter(Number.isFinite).sort((a, b) => a - b);
    return known[Math.floor(known.length / 2)];
  }

  function filters(found) {
    if (!found) return null;
    const series = found.curves.flatMap((s) => {
      const style = look(s.row), curve = { label: s.label, x: s.x, y: s.y[0], low: s.y[1], high: s.y[2], ...style };
      return s.bound ? [curve, { ...style, label: "bound on its mean trace P", x: s.x, y: s.bound, dash: "dotted", width: 1 }] : [curve];
    });
    const lines = found.central === null ? [] : [{ label: "centralised filter, trace of P by theory:", y: found.central, colour: "ink", dash: "dotted" }];
    const levels = found.curves.map((s) => median(s.y[0])).filter((level) => level > 0);
    const apart = Math.max(...levels) > APART * Math.min(...levels);
    return { title: "Mean square error over time", unit: "squared " + page.unit, timed: true, series, lines, apart,
      note: "Mean over the nodes and " + Format.count(found.runs) + " runs of each; shaded: two standard errors." };
  }

  function sweep(app, found) {
    if (!found) return null;
    const series = found.series.map((s, k) => ({ label: s.label, x: s.x, y: s.y[0], low: s.y[1], high: s.y[2], ...look(k), points: true }));
    return { title: "Worst node over the sweep", unit: "RMS error, " + page.unit, xlabel: found.key, series, note: "Shaded: two standard errors." };
  }

  function all(app, page) {
    const live = page.runs.length > 0;
    return [
      difference(app, page.difference), ensemble(app, page.ensembles), ensembleNees(app, page.ensembles),
      live && errors(app, page.runs), live && nees(app, page.runs), live && innovations(app, page.runs), live && whiteness(app, page.runs), live && ages(app, page.runs),
      live && traffic(app, page.runs), averages(app, page.summaries), sweep(app, page.sweep), filters(page.filters),
    ].filter(Boolean);
  }

  return { all };
})();
