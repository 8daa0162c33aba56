// Format numbers, and make small elements. An unknown value is a dash.
export const dash = "–";

export function fixed(value, digits, unit = "") {
  return value === null || value === undefined ? dash : value.toFixed(digits).replace("-", "−") + (unit && "\u202f" + unit);
}

export function utc(ns, withMillis = false) {
  if (ns === null || ns === undefined) return dash;
  return new Date(ns / 1e6).toISOString().slice(11, withMillis ? 23 : 19);
}

export function element(name, attributes = {}, ...children) {
  const one = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) if (value !== null) one.setAttribute(key, value);
  one.append(...children);
  return one;
}

const SVG = "http://www.w3.org/2000/svg";
export function svg(name, attributes = {}, ...children) {
  const one = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) one.setAttribute(key, value);
  one.append(...children);
  return one;
}

const MARKS = { go: "M2 8l4 4 8-9", caution: "M8 2v8M8 13v1.5", "no-go": "M3 3l10 10M13 3L3 13" };
export function mark(state) {
  const words = { go: "go", caution: "caution", "no-go": "no-go" };
  const one = svg("svg", { viewBox: "0 0 16 16", role: "img", "aria-label": words[state] ?? "unknown" });
  one.append(svg("path", { d: MARKS[state] ?? "M3 8h10", fill: "none", stroke: "currentColor", "stroke-width": "2.4", "stroke-linecap": "round" }));
  return one;
}

export function rows(list, pairs) {
  list.replaceChildren(...pairs.flatMap(([name, value, bad]) => {
    const dd = element("dd", { class: bad ? "bad" : null });
    dd.textContent = value;
    return [element("dt", {}, name), dd];
  }));
}
