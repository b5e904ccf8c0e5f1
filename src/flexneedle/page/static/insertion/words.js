// How an insertion goes, or has ended, in words.

import { shown } from "../dom.js";

const STATES = {
  waiting: "Waiting for the computation", planning: "Planning", ready: "Ready", running: "Running", paused: "Paused",
  holding: "Holding", done: "Ended", held: "Held", failed: "Failed", interrupted: "Stopped", refused: "Refused",
};

// insertion: the news of that type.
export function inWords(insertion) {
  const where = insertion.rig ? ` on ${insertion.rig}` : "";
  const parts = [`${STATES[insertion.state] ?? insertion.state}${where}: ${insertion.controller}, seed ${insertion.seed}, ${insertion.periods} periods.`];
  if (insertion.summary) parts.push(insertion.summary);
  else if ((insertion.error_mm ?? null) !== null) parts.push(`The tip ended ${shown(insertion.error_mm, 3)} mm from the target.`);
  if (insertion.folder) parts.push(`Recorded as ${insertion.folder}.`);
  return parts.join(" ");
}
