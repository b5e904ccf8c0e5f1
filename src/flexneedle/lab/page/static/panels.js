// The panels of the page and of a replay: a section with a heading, and a place for its module.

import { make } from "./dom.js";

const HEADINGS = {
  space: "In space", player: "Time", section: "Section", axial: "Along the axis", plans: "Plan", insertion: "Insertion",
  plots: "Plots", files: "Files", form: "Scenario",
};

// Add panels to an element.
export function addPanels(element, names) {
  for (const name of names) {
    const heading = make("h2", { id: `h-${name}` }, HEADINGS[name]);
    element.append(make(`section.panel.${name}`, { "aria-labelledby": heading.id }, heading, make("div", { "data-panel": name })));
  }
}
