// Colours of canvases: read from the style sheet, so that light and dark are defined once.
const Theme = (() => {
  const NAMES = ["ink", "soft", "faint", "paper", "panel", "blue", "red", "orange", "green", "purple"];
  let found = {};

  function read() {
    const style = getComputedStyle(document.documentElement);
    for (const name of [...NAMES, ...page.series]) found[name] = style.getPropertyValue("--" + name).trim();
    return found;
  }

  // Yellow to dark blue: the larger the darker, as in the figures of netkf plot, so that it is read
  // in grey and by colour-blind readers (the ends and middle of the map cividis_r).
  const STOPS = [[254, 232, 56], [187, 173, 109], [124, 123, 120], [66, 78, 108], [0, 34, 78]];

  function scale(share) {
    const at = Math.min(1, Math.max(0, Number.isFinite(share) ? share : 1)) * (STOPS.length - 1);
    const k = Math.min(STOPS.length - 2, Math.floor(at)), part = at - k;
    const mix = STOPS[k].map((from, c) => Math.round(from + part * (STOPS[k + 1][c] - from)));
    return "rgb(" + mix.join(",") + ")";
  }

  // A canvas with the pixels of the screen; drawing then uses CSS pixels.
  function canvas(target, height) {
    const width = Math.max(1, target.clientWidth), ratio = window.devicePixelRatio || 1;
    if (target.width !== Math.round(width * ratio) || target.height !== Math.round(height * ratio)) {
      target.width = Math.round(width * ratio);
      target.height = Math.round(height * ratio);
    }
    const context = target.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    return { context, width, height };
  }

  // Words on a canvas, with an edge that parts them from what lies below.
  function write(context, text, x, y) {
    context.font = "12px system-ui, sans-serif";
    context.textBaseline = "middle";
    context.textAlign = "left";
    context.lineWidth = 3;
    const width = context.canvas.width / context.getTransform().a; // a long name would end outside
    x = Math.max(0, Math.min(x, width - context.measureText(text).width - 3));
    context.strokeStyle = found.panel;
    context.strokeText(text, x, y);
    context.fillStyle = found.ink;
    context.fillText(text, x, y);
  }

  function calm() {
    return matchMedia("(prefers-reduced-motion: reduce)").matches;
  }

  function watch(redraw) {
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { read(); redraw(); });
    window.addEventListener("resize", redraw);
  }

  return { read, scale, canvas, write, calm, watch, get colours() { return found; } };
})();
