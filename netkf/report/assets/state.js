// What is true at a time: the samples and messages that the views draw. Nothing here draws.
const State = (() => {
  const OUTCOMES = ["delivered", "lost", "late", "under way"];
  const DELIVERED = 0, LOST = 1, LATE = 2;

  // The index of the first entry above a value in increasing numbers.
  function above(values, value) {
    let low = 0, high = values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] <= value) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  // The last sample at or before t, or -1. Estimates are known at samples only: nothing between
  // them is made up.
  function sampleAt(run, t) {
    return above(run.samples.t, t) - 1;
  }

  function firstSent(m, t) {
    let low = 0, high = m.bySent.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (m.sent[m.bySent[middle]] < t) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  // A message is on show from when it was sent until it has ended, and `persist` seconds at least.
  function messagesAt(run, t, persist) {
    const m = run.messages, found = [];
    const start = firstSent(m, t - Math.max(persist, m.longest) * (1 + 1e-9));
    for (let k = start; k < m.bySent.length; k++) {
      const row = m.bySent[k];
      if (m.sent[row] > t) break;
      const ended = Number.isFinite(m.ended[row]) ? m.ended[row] : m.sent[row];
      if (t < Math.max(ended, m.sent[row] + persist) || t === m.sent[row]) found.push(row);
    }
    const known = new Set(found);
    for (const row of m.endless) if (m.sent[row] <= t && !known.has(row)) found.push(row);
    return found;
  }

  function outcomeAt(run, row, t) {
    const m = run.messages, outcome = m.outcome[row];
    return outcome !== LOST && t < m.ended[row] ? "under way" : OUTCOMES[outcome];
  }

  function sampleOf(run, k, i) {
    const s = run.samples, n = run.n, width = (n * (n + 1)) / 2, at = k * run.N + i;
    return {
      node: run.nodes[i],
      xhat: Array.from(s.xhat.subarray(at * n, at * n + n)),
      P: Array.from(s.P.subarray(at * width, at * width + width)),
      error: s.sq_error ? Math.sqrt(s.sq_error[at]) : NaN,
      nees: s.nees ? s.nees[at] : NaN,
      bound: s.bound ? s.bound[at] : NaN,
      age: s.age[at],
      trace: traceOf(s.P.subarray(at * width, at * width + width), n),
    };
  }

  function traceOf(upper, n) {
    let sum = NaN;
    // A node may estimate fewer states than others.
    for (let i = 0, at = 0; i < n; at += n - i, i++) if (Number.isFinite(upper[at])) sum = (sum || 0) + upper[at];
    return sum;
  }

  function variance(upper, n, i, j) {
    const a = Math.min(i, j), b = Math.max(i, j);
    return upper[a * n - (a * (a - 1)) / 2 + b - a];
  }

  function truthAt(run, k) {
    return run.samples.x && k >= 0 ? Array.from(run.samples.x.subarray(k * run.n, k * run.n + run.n)) : null;
  }

  // All of it as plain values: what tests compare with the trace.
  function at(run, t, persist) {
    const k = sampleAt(run, t), m = run.messages;
    const nodes = k < 0 ? [] : run.nodes.map((_, i) => sampleOf(run, k, i));
    const messages = messagesAt(run, t, persist).map((row) => ({
      sender: run.nodes[m.sender[row]], receiver: run.nodes[m.receiver[row]], number: m.number[row],
      sent: m.sent[row], age: m.age[row], state: outcomeAt(run, row, t),
    }));
    return { t, sample: k < 0 ? null : run.samples.t[k], x: truthAt(run, k), nodes, messages };
  }

  // The half axes and the direction of the ellipse of a 2 x 2 covariance.
  function ellipse(a, b, c, scale) {
    const middle = 0.5 * (a + c), gap = Math.hypot(0.5 * (a - c), b);
    const angle = 0.5 * Math.atan2(2 * b, a - c);
    return {
      major: scale * Math.sqrt(Math.max(0, middle + gap)),
      minor: scale * Math.sqrt(Math.max(0, middle - gap)), angle,
    };
  }

  return { above, sampleAt, firstSent, messagesAt, outcomeAt, sampleOf, variance, truthAt, at,
    ellipse, OUTCOMES, DELIVERED, LOST, LATE };
})();
