// A drag over a chart of time chooses the stretch of time that all charts show; a click is a click.
const Brush = (() => {
  const LEAST = 6; // pixels; a shorter drag is a click

  // `axis` ("x" or "y") is that of time, `timeAt` turns pixels along it into seconds.
  function listen(target, app, axis, timeAt, click) {
    const mark = Format.element("div", { class: "brush", "aria-hidden": "true" });
    let start = null;
    const at = (event) => {
      const edge = target.getBoundingClientRect();
      return { x: event.clientX - edge.left, y: event.clientY - edge.top };
    };
    const isDrag = (now) => start !== null && Math.abs(now[axis] - start[axis]) > LEAST;
    target.addEventListener("pointerdown", (event) => { if (event.button === 0) start = at(event); });
    target.addEventListener("pointermove", (event) => { if (isDrag(at(event))) show(event); });
    target.addEventListener("dblclick", () => app.setSpan(null));
    window.addEventListener("pointercancel", end);
    window.addEventListener("pointerup", (event) => {
      if (start === null) return;
      const now = at(event), ends = [start[axis], now[axis]].sort((a, b) => a - b).map(timeAt);
      if (isDrag(now)) app.setSpan([Math.max(0, ends[0]), Math.min(app.end, ends[1])]);
      else click(now);
      end();
    });

    function end() { start = null; mark.remove(); }

    function show(event) {
      const edge = target.getBoundingClientRect(), now = at(event), low = Math.min(start[axis], now[axis]);
      const size = Math.abs(now[axis] - start[axis]), wide = axis === "x";
      document.body.append(mark);
      mark.style.left = window.scrollX + edge.left + (wide ? low : 0) + "px";
      mark.style.top = window.scrollY + edge.top + (wide ? 0 : low) + "px";
      mark.style.width = (wide ? size : edge.width) + "px";
      mark.style.height = (wide ? edge.height : size) + "px";
    }
  }

  return { listen };
})();
