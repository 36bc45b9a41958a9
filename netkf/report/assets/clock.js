// The one clock of all views.
const Clock = (() => {
  const STEPS = [1, 2, 5];
  const SHOWN = 0.45; // seconds on the wall for which a message without travel is on show

  // Speeds in simulated seconds for each second on the wall, about two hundred to one.
  function speeds(horizon) {
    const found = [];
    const low = Math.floor(Math.log10(horizon / 5000)), high = Math.ceil(Math.log10(horizon / 4));
    for (let power = low; power <= high; power++) {
      for (const step of STEPS) {
        const speed = Number((step * 10 ** power).toPrecision(3));
        if (speed >= horizon / 5000 && speed <= horizon / 3) found.push(speed);
      }
    }
    return found.length ? found : [1];
  }

  // The whole run in forty seconds, but no more than two slots in one.
  function usual(horizon, period) {
    const wanted = period > 0 ? Math.min(horizon / 40, 2 * period) : horizon / 40;
    const off = (speed) => Math.abs(Math.log(speed / wanted));
    return speeds(horizon).reduce((best, speed) => (off(speed) < off(best) ? speed : best));
  }

  // Calls `advance` with the simulated seconds that have passed at each frame of the screen. With
  // reduced motion it moves twice a second, without anything in between.
  function start(app) {
    let last = null;
    function frame(now) {
      if (!app.playing) { last = null; return; }
      if (last === null) last = now;
      const passed = (now - last) / 1000;
      if (!Theme.calm() || passed >= 0.5) {
        app.advance(passed * app.speed);
        last = now;
      }
      requestAnimationFrame(frame);
    }
    requestAnimationFrame(frame);
  }

  return { speeds, usual, start, SHOWN };
})();
