// Rows of a study: the worst first, or from an index on; a row is computed again to be opened or compared.

import { button, make, shown } from "../dom.js";

export function showStudy(element, store, link) {
  const title = make("summary");
  const first = make("input", { type: "number", min: "0", step: "1", placeholder: "Row", "aria-label": "First row" });
  const ask = (index) => link.ask({ type: "study", name: store.get("study").name, index });
  const worst = button("Worst first", () => ask(null));
  const from = make("form.tools", {}, worst, first, make("button", { type: "submit" }, "From this row"));
  const list = make("ul.study-rows", { "aria-label": "Rows of the study" });
  const details = make("details", { hidden: true, open: true }, title, from, list);
  element.append(details);
  from.addEventListener("submit", (event) => {
    event.preventDefault();
    if (first.value) ask(first.valueAsNumber);
  });
  store.subscribe(["study"], () => {
    const study = store.get("study");
    details.hidden = !study;
    if (!study) return;
    title.textContent = `${study.name}: ${study.title}, ${study.finished} of ${study.insertions} rows`;
    list.replaceChildren(...study.rows.map((row) => entryOf(study.name, row, link)), ...remarks(study));
  });
}

function entryOf(name, { index, settings, controller, target, error_mm, outcome, reason, opens }, link) {
  const open = (second) => link.ask({ type: "open", name, row: index, second });
  const error = error_mm === null ? [] : [`${shown(error_mm, 3)} mm off`];
  const place = `target ${target.slice(0, target[2] ? 3 : 2).join(", ")} mm`;
  const about = `${[outcome, ...error].join(", ")}: ${[settings, controller, place].filter(Boolean).join(", ")}`;
  const tools = opens
    ? [button("Open", () => open(false), { "aria-label": `Open row ${index}` }), button("Compare", () => open(true), { "aria-label": `Compare with row ${index}` })]
    : [];
  const why = reason ? [make("span.quiet", {}, reason)] : [];
  return make("li.run", {}, make("strong", {}, `Row ${index}`), make("span.quiet", {}, about), ...why, make("div.tools", {}, ...tools));
}

function remarks({ rows, index, finished }) {
  if (!rows.length) return [make("li.quiet", {}, index === null ? "No row is finished yet" : `No finished row from ${index} on`)];
  if (rows.length < finished) return [make("li.quiet", {}, `${rows.length} of ${finished} finished rows: choose the first row for others`)];
  return [];
}
