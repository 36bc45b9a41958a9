// Numbers in words and elements from data. Text from files enters the page through textContent
// alone, so that markup in it stays text.
const Format = (() => {
  // The four significant digits of the command line's tables, Python's "%.4g". toPrecision would
  // round ties away from zero where Python rounds them to even, hence the digits by hand.
  function number(value) {
    if (value === null || value === undefined || !Number.isFinite(value)) return "-";
    if (value === 0) return Object.is(value, -0) ? "-0" : "0";
    const parts = Math.abs(value).toExponential(60).split("e");
    const all = parts[0].replace(".", "");
    let exponent = Number(parts[1]);
    let kept = Number(all.slice(0, 4));
    const rest = all.slice(4), half = "5".padEnd(rest.length, "0");
    if (rest > half || (rest === half && kept % 2 === 1)) kept += 1;
    if (kept === 10000) { kept = 1000; exponent += 1; }
    return (value < 0 ? "-" : "") + place(String(kept), exponent);
  }

  function place(digits, exponent) {
    const bare = digits.replace(/0+$/, "");
    if (exponent < -4 || exponent >= 4) {
      const size = String(Math.abs(exponent)).padStart(2, "0");
      const mantissa = bare.length > 1 ? bare[0] + "." + bare.slice(1) : bare;
      return mantissa + "e" + (exponent < 0 ? "-" : "+") + size;
    }
    if (exponent < 0) return "0." + "0".repeat(-exponent - 1) + bare;
    const whole = digits.slice(0, exponent + 1), part = digits.slice(exponent + 1).replace(/0+$/, "");
    return part ? whole + "." + part : whole;
  }

  // Times keep enough digits to tell neighbouring events apart.
  function time(value) {
    return Number.isFinite(value) ? String(Number(value.toPrecision(7))) : "-";
  }

  function count(value) {
    return String(value).replace(/\B(?=(\d{3})+(?!\d))/g, ",");
  }

  function brief(value, most) {
    const name = String(value);
    return name.length > most ? name.slice(0, most - 1) + "\u2026" : name;
  }

  function element(tag, attributes, ...children) {
    const svg = ["svg", "g", "line", "path", "circle", "rect", "text", "title", "polygon"].includes(tag);
    const made = svg
      ? document.createElementNS("http://www.w3.org/2000/svg", tag)
      : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) {
      if (value !== null && value !== undefined) made.setAttribute(name, value);
    }
    for (const child of children) {
      made.append(child instanceof Node ? child : document.createTextNode(String(child)));
    }
    return made;
  }

  function table(caption, header, rows) {
    const head = element("tr", {}, ...header.map((cell) => element("th", { scope: "col" }, cell)));
    const lines = rows.map(([first, ...others]) =>
      element("tr", {}, element("th", { scope: "row" }, first),
        ...others.map((cell) => element("td", {}, cell))));
    const made = element("table", { class: "numbers" }, element("caption", {}, caption),
      element("thead", {}, head), element("tbody", {}, ...lines));
    return element("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": caption }, made);
  }

  // A table as CSV, offered as a file; cells with commas, quotes or line ends are quoted.
  function csv(table) {
    const cell = (text) => (/[",\n]/.test(text) ? '"' + text.replace(/"/g, '""') + '"' : text);
    return [...table.rows].map((row) => [...row.cells].map((c) => cell(c.textContent)).join(",")).join("\r\n") + "\r\n";
  }

  function offerCsv(table) {
    const caption = table.caption ? table.caption.textContent : "table";
    const name = caption.replace(/[^A-Za-z0-9]+/g, "-").replace(/^-|-$/g, "").slice(0, 60).toLowerCase() + ".csv";
    const button = element("button", { type: "button", class: "csv", "aria-label": "Download as CSV: " + caption }, "CSV");
    button.addEventListener("click", () => {
      const url = URL.createObjectURL(new Blob([csv(table)], { type: "text/csv" }));
      element("a", { href: url, download: name }).click();
      setTimeout(() => URL.revokeObjectURL(url), 10000);
    });
    return button;
  }

  // Each table of the page has its button, those that the script makes later too.
  function offerTables(root) {
    for (const box of root.querySelectorAll(".scroll > table")) {
      if (!box.parentNode.querySelector(".csv")) box.before(offerCsv(box));
    }
  }

  return { number, time, count, brief, element, table, csv, offerTables };
})();
