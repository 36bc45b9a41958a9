// uPlot formats numbers by the browser's language, and a name of it that is none (en-US@posix of
// Chromium under LANG=C) would end the whole script.
try { new Intl.NumberFormat(navigator.language); } catch { Object.defineProperty(navigator, "language", { value: "en-US" }); }
