// A line that explains why a shown insertion cannot be edited, with a button back to the scene.

import { button, make } from "./dom.js";
import { SHOWN, maySteer, runs, shownOf } from "./shown.js";

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
  store.subscribe([...SHOWN, "clients", "welcome"], () => {
    const still = Boolean(store.get("scene")) && shownOf(store) !== "scene"; // a replay has no scene
    words.textContent = `This is ${shownOf(store) === "first" ? "a recorded run" : "an insertion"}. To move the target:`;
    note.hidden = !still || !maySteer(store) || runs(store.get("insertion live"));
  });
  return note;
}
