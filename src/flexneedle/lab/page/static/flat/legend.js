// The legend of a drawing, replaced only when it differs.

import { make } from "../dom.js";

export function legendOf(element, parts, reached) {
  const entries = parts.filter(({ text }) => text).map(({ text, tone, dash, thick, sampled, spread, cross }) => [
    text, tone, cross ? "cross" : dash ? "dashed" : thick ? "thick" : sampled ? "thin" : spread ? "area" : "line",
  ]);
  if (reached) entries.unshift(["reach", "--reach", "area"]);
  entries.push(["target, 1 mm", "--target", "disc"]);
  const key = JSON.stringify(entries);
  if (element.dataset.entries === key) return;
  element.dataset.entries = key;
  element.replaceChildren(...entries.map(([text, tone, form]) => {
    const swatch = make(`span.swatch.${form}`, { "aria-hidden": "true" });
    swatch.style.color = `var(${tone})`;
    return make("li", {}, swatch, text);
  }));
}
