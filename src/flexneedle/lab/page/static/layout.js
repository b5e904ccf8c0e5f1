// The layout of the page and of a replay: views of the scene, the timeline and the action bar always in view; beside
// them tabs, of which one is shown and scrolls.
//   "view scene": "space" (default) or "section"; "view inset": false hides the view along the axis
//   "view notice": why there is no view in space

import { button, make } from "./dom.js";
import { addTabs } from "./tabs.js";

const HEADINGS = {
  space: "In space", section: "Section", axial: "Along the axis", player: "Time", actions: "Actions", form: "Scenario",
  plans: "Plan", insertion: "Insertion", plots: "Plots", files: "Files", rig: "Rig",
};
const VIEWS = { space: "Space", section: "Section" };

// below: panels below the scene; tabs: panels beside it, the first one shown.
export function layOut(store, below, tabs) {
  const [views, axial] = [Object.keys(VIEWS).map(panelOf), panelOf("axial")];
  const choices = Object.entries(VIEWS).map(([name, text]) => button(text, () => store.set("view scene", name), { "data-view": name }));
  const inset = button("Inset", () => store.set("view inset", store.get("view inset") === false), { "data-view": "axial", title: "The view along the axis, in a corner" });
  const group = make("div.tools.switch", { role: "group", "aria-label": "View of the scene" }, ...choices, inset);
  const notice = make("p.quiet.notice", { role: "note", hidden: true });
  const scene = make("div.scene", {}, group, ...views, axial, notice);
  document.getElementById("main").append(scene, ...below.map(panelOf));
  addTabs(document.getElementById("side"), store, tabs.map((name) => [name, HEADINGS[name], panelOf(name)]));
  store.subscribe(["view scene", "view inset", "view notice"], () => {
    const chosen = store.get("view scene") ?? "space";
    for (const view of views) view.hidden = !view.classList.contains(chosen);
    for (const each of choices) each.setAttribute("aria-pressed", String(each.dataset.view === chosen));
    axial.hidden = store.get("view inset") === false;
    inset.setAttribute("aria-pressed", String(!axial.hidden));
    notice.textContent = store.get("view notice") ?? "";
    choices[0].disabled = Boolean(notice.textContent);
    notice.hidden = !notice.textContent;
  });
}

// A section with a heading, and a place for its module.
function panelOf(name) {
  const heading = make("h2.spoken", { id: `h-${name}` }, HEADINGS[name]);
  return make(`section.panel.${name}`, { "aria-labelledby": heading.id }, heading, make("div", { "data-panel": name }));
}
