// Table of plans: the weighted terms of the cost of each, its end, and its load on the tissue.

import { brief, make, shown } from "../dom.js";
import { loadRows } from "../load.js";

const ROWS = [
  ["Error at the target (mm)", ({ error_mm: error }) => shown(error, 3)],
  ["Planning time (s)", ({ seconds }) => shown(seconds, 2)],
];

// The table in a list; an empty list without plans.
export function termsTable(plans) {
  if (!plans.length) return [];
  const row = (name, cell) => make("tr", {}, make("th", { scope: "row" }, name), ...plans.map((plan) => make("td.number", {}, cell(plan))));
  const names = [...new Set(plans.flatMap(({ terms }) => Object.keys(terms)))];
  const most = Math.max(...plans.flatMap(({ terms }) => Object.values(terms)), 1e-12);
  const terms = names.map((name) => row(`Cost: ${name}`, ({ terms }) => barOf(terms[name], most)));
  const head = make("tr", {}, make("td"), ...plans.map(({ strategy }) => make("th.number", { scope: "col" }, strategy)));
  const caption = make("caption.spoken", {}, "Plans and the terms of their cost");
  return [make("table", {}, caption, make("thead", {}, head), make("tbody", {}, ...terms, row("Cost (mm)", ({ cost }) => brief(cost)), ...ROWS.map((each) => row(...each)), ...loadRows(plans.map(({ load }) => load))))];
}

// A number with a bar of that length.
function barOf(value, most) {
  if (value === undefined) return "–";
  const bar = make("meter", { min: "0", max: String(most), value: String(value), "aria-hidden": "true" });
  return make("span.bar", {}, bar, brief(value));
}
