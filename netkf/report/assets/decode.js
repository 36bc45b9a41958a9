// The columns of the page, back from their text: see packing.py.
const Decode = (() => {
  const ARRAYS = { f8: Float64Array, u4: Uint32Array, u2: Uint16Array, u1: Uint8Array, i2: Int16Array };

  async function columns(text, sizes) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const whole = new Uint8Array(await new Response(stream).arrayBuffer());
    const starts = [];
    sizes.reduce((start, size) => { starts.push(start); return start + size; }, 0);
    return (column) => whole.subarray(starts[column.part], starts[column.part] + sizes[column.part]);
  }

  // Bytes come in planes: the first bytes of all numbers, then their second bytes, and so on.
  function array(column, bytes) {
    const kind = ARRAYS[column.type], width = kind.BYTES_PER_ELEMENT;
    const size = bytes.length / width, out = new Uint8Array(bytes.length);
    for (let plane = 0; plane < width; plane++) {
      const from = plane * size;
      for (let k = 0; k < size; k++) out[k * width + plane] = bytes[from + k];
    }
    return new kind(out.buffer);
  }

  function arrays(described, bytesOf) {
    const found = {};
    for (const [name, column] of Object.entries(described)) found[name] = array(column, bytesOf(column));
    return found;
  }

  function run(data, bytesOf) {
    const samples = { ...data.samples, ...arrays(data.samples.columns, bytesOf) };
    const messages = { ...data.messages, ...arrays(data.messages.columns, bytesOf) };
    const made = { ...data, samples, messages };
    made.senses = { ...data.senses, ...arrays(data.senses.columns, bytesOf) };
    made.marks = { ...data.marks, ...arrays(data.marks.columns, bytesOf) };
    if (data.innovations) made.innovations = { ...data.innovations, ...arrays(data.innovations.columns, bytesOf) };
    made.N = data.nodes.length;
    const sensors = new Set(data.sensors);
    made.sensing = data.nodes.map((node) => sensors.has(node));
    made.readings = readingTimes(made.senses, made.N);
    made.index = new Map(data.nodes.map((node, k) => [node, k]));
    complete(messages, made.N);
    return made;
  }

  function readingTimes(senses, nodes) {
    const times = Array.from({ length: nodes }, () => []);
    for (let k = 0; k < senses.t.length; k++) times[senses.node[k]].push(senses.t[k]);
    return times;
  }

  function complete(m, nodes) {
    let last = 0;
    for (let k = 0; k < m.count; k++) {
      last = (last + m.number[k]) >>> 0; // differences modulo 2^32
      m.number[k] = last;
    }
    m.ended = m.travel.map((ended, k) => (ended === 0 ? m.sent[k] : ended));
    m.bySent = Uint32Array.from(m.sent.keys());
    m.bySent.sort((a, b) => m.sent[a] - m.sent[b] || m.phase[a] - m.phase[b] || a - b);
    m.longest = 0;
    m.endless = [];
    for (let k = 0; k < m.count; k++) {
      const travel = m.ended[k] - m.sent[k];
      if (Number.isFinite(travel)) m.longest = Math.max(m.longest, travel);
      else m.endless.push(k);
    }
    m.into = links(m, nodes);
  }

  // For each node the links into it, each a range of rows: rows are ordered by link.
  function links(m, nodes) {
    const into = Array.from({ length: nodes }, () => []);
    for (let k = 0; k < m.count; ) {
      let end = k + 1;
      while (end < m.count && m.sender[end] === m.sender[k] && m.receiver[end] === m.receiver[k]) end++;
      into[m.receiver[k]].push({ sender: m.sender[k], from: k, to: end });
      k = end;
    }
    return into;
  }

  return { columns, run };
})();
