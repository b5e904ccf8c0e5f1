// A line that explains why a shown insertion cannot be edited, with a button back to the scene, or that its needle is outdated.

import { button, make } from "./dom.js";
import { SHOWN, STEERING, maySteer, runs, shownOf } from "./shown.js";

export const TARGET_AND_PLAN = "Target and plan";

// The line of a view with handles; hidden while there are handles, and while an insertion runs.
export function stillNote(store) {
  const back = button(TARGET_AND_PLAN, () => {
    store.set("view of", "scene");
    store.set("view period", undefined);
    store.set("view playing", undefined);
  });
  const words = make("span");
  const note = make("p.tools.quiet", { hidden: true }, words, back);
  store.subscribe([...SHOWN, ...STEERING], () => {
    const of = shownOf(store);
    const still = Boolean(store.get("scene")) && of !== "scene"; // a replay has no scene
    const moved = of === "live" && Boolean(store.get("insertion live")?.moved);
    back.hidden = moved || !still || !maySteer(store) || runs(store.get("insertion live"));
    const at = "The needle is drawn where the insertion ended: the rig has moved since.";
    words.textContent = moved ? at : `This is ${of === "first" ? "a recorded run" : "an insertion"}. To move the target:`;
    note.classList.toggle("moved", moved);
    note.hidden = back.hidden && !moved;
  });
  return note;
}
