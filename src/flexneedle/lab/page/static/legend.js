// The legend of a drawing.

import { make } from "./dom.js";

const TARGET = { text: "target, 1 mm", tone: "--target", form: "disc" };
const OTHER = { ...TARGET, text: "other targets", faint: true };

// Show entries {text, tone, form} or {text, ramp}, and the target, in a list; replaced only where they differ. others: the
// other targets.
export function showLegend(element, entries, others = []) {
  const all = [...entries, TARGET, ...(others.length ? [OTHER] : [])];
  const key = JSON.stringify(all);
  if (element.dataset.entries === key) return;
  element.dataset.entries = key;
  element.replaceChildren(...all.map(entryOf));
}

function entryOf({ text, tone, form, ramp, faint }) {
  const swatch = make(`span.swatch.${ramp ? "area" : form ?? "line"}`, { "aria-hidden": "true" });
  if (tone) swatch.style.color = `var(${tone})`;
  if (faint) swatch.style.opacity = "0.3";
  if (ramp) {
    const stops = ramp.map((rgb) => `rgb(${rgb.map((value) => Math.round(255 * value)).join(" ")})`);
    swatch.style.background = `linear-gradient(to right, ${stops.join(", ")})`;
    swatch.style.opacity = "1";
  }
  return make("li", {}, swatch, text);
}
