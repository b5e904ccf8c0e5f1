// Load on the tissue (Invasiveness of the package): plans or insertions side by side.

import { make } from "./dom.js";

// Rows of a table with a cell for each load; a load is an object of texts by name.
export function loadRows(loads) {
  const names = [...new Set(loads.flatMap(Object.keys))];
  return names.map((name) => make("tr", {}, make("th", { scope: "row" }, name), ...loads.map((load) => make("td.number", {}, load[name] ?? "–"))));
}

// The table of insertions that ended, in a list; an empty list without any.
export function loadTable(insertions) {
  const ended = insertions.filter((insertion) => insertion && Object.keys(insertion.load).length);
  if (!ended.length) return [];
  const heads = ended.map(({ name, controller }) => make("th.number", { scope: "col" }, `${name}, ${controller}`));
  const head = make("thead", {}, make("tr", {}, make("td"), ...heads));
  const caption = make("caption.spoken", {}, "Load on the tissue");
  return [make("div.load", {}, make("table", {}, caption, head, make("tbody", {}, ...loadRows(ended.map(({ load }) => load)))))];
}
