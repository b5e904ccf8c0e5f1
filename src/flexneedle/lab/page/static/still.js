// A line that explains why a shown insertion cannot be edited, with a button back to the scene, or that its needle is outdated.

import { button, make } from "./dom.js";
import { SHOWN, STEERING, maySteer, runs, shownOf } from "./shown.js";

export const TARGET_AND_PLAN = "Target and plan";
const MOVED = "The needle is drawn where the insertion ended: the rig has moved since.";

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
    const elsewhere = of === "live" ? whereNotNow(store) : "";
    back.hidden = elsewhere === MOVED || !still || !maySteer(store) || runs(store.get("insertion live"));
    words.textContent = elsewhere || `This is ${of === "first" ? "a recorded run" : "an insertion"}. To move the target:`;
    note.classList.toggle("moved", Boolean(elsewhere));
    note.hidden = back.hidden && !elsewhere;
  });
  return note;
}

// Return a note that the needle of a rig may be elsewhere than drawn; "" if it is there.
function whereNotNow(store) {
  const live = store.get("insertion live");
  if (live?.moved) return MOVED;
  const unseen = live?.rig && !runs(live) && !store.get("rows live")?.length; // refused, or stopped before its first period
  if (unseen) return "The needle is drawn at the start of the plan: where it is now has not been measured.";
  return "";
}
