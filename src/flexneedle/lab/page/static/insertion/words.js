// State or outcome of an insertion, in words.

import { shown } from "../dom.js";
import { ENDED } from "../shown.js";

const STATES = {
  waiting: "Waiting for the computation", planning: "Planning", ready: "Prepared, not armed", running: "Running", paused: "Paused",
  holding: "Holding", done: "Ended", held: "Held", failed: "Failed", interrupted: "Stopped", refused: "Refused",
};
const ARMED = { ready: { armed: "Armed for one start", starting: "Starting" }, holding: { armed: "Holding, armed to continue" } };

const TOLD = /^(held|interrupted) /; // summaries that begin with the outcome
const COUNTED = ["paused", "done", "held", "failed", "interrupted"]; // else the player counts the periods

// insertion: the message of that type; rows: of its periods; rig: its state, if it is connected.
export function inWords(insertion, rows = [], rig = null) {
  const where = insertion.rig ? ` on ${insertion.rig}` : "";
  const count = COUNTED.includes(insertion.state) ? `, ${insertion.periods} periods` : "";
  const stands = insertion.rig && insertion.state === "running" && ENDED.includes(rig?.state);
  const armed = insertion.rig && ARMED[insertion.state]?.[rig?.state];
  const state = stands ? (rig.state === "ended" ? "Ended" : "Stopped") : armed || (STATES[insertion.state] ?? insertion.state);
  const to = insertion.target_name ? ` to ${insertion.target_name}` : "";
  const told = TOLD.test(insertion.summary);
  const parts = told ? [] : [`${state}${where}${to}: ${insertion.controller}, seed ${insertion.seed}${count}.`];
  if (stands) parts.push("The record is being written.");
  if (insertion.state === "ready" && rig?.state !== "starting") parts.push("Nothing moves.");
  if (insertion.summary) parts.push(sentence(insertion.summary));
  else if (insertion.state === "running" && rows.at(-1)?.action === "hold") parts.push("The needle is held, for the reason in the decisions.");
  else if ((insertion.error_mm ?? null) !== null) parts.push(`The tip ended ${shown(insertion.error_mm, 3)} mm from the target.`);
  if (told) parts.push(`With ${insertion.controller}, seed ${insertion.seed}${where}${to}.`);
  if (insertion.folder) parts.push(`Recorded as ${insertion.folder}.`);
  return parts.join(" ");
}

const sentence = (text) => text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".");
