// The connected rig: its state, the findings of a check, and the motions that are confirmed before it is armed.

import { make, renew } from "./dom.js";
import { STEERING, isCut, isStale, maySteer } from "./shown.js";

const STATES = {
  idle: "is not in use", preparing: "is being prepared: the path is planned, the devices are opened; nothing moves",
  ready: "is prepared; nothing moves before it is armed and started", armed: "is armed for one start; nothing moves before it",
  starting: "starts: motors are switched on, the needle is rolled as the plan begins", inserting: "inserts",
  holding: "holds: the needle rests where it is", stopped: "was stopped", fault: "has a fault",
  ended: "is at rest; the record is being written",
};
const RETRACTION = {
  preparing: "is being prepared to retract: the position is read; nothing moves", starting: "starts: motors are switched on",
  retracting: "is withdrawing the needle", ended: "is at rest",
};
const OVER = ["idle", "stopped", "fault"];

export function mount(element, store) {
  const [name, state] = [make("strong"), make("p", { role: "status" })];
  const [findings, moves] = [make("div.findings"), make("ul.moves", { "aria-label": "Motions" })];
  const free = make("input", { id: "rig-free", type: "checkbox" });
  const seen = make("label.tools", { for: "rig-free" }, free, "I have read the motions, their path is free, and I can see the rig and reach its emergency stop.");
  const retract = make("p", { hidden: true }, "The needle may still be in the tissue: Retract withdraws it along its path.");
  element.append(name, state, moves, seen, retract, findings);
  let was = "";
  const show = () => {
    const rig = store.get("rig");
    if (!rig || !store.get("clients")) return; // who is in control follows
    if (rig.state !== "armed" && was === "armed") store.set("view confirmed", undefined);
    if (rig.state !== was && waits(rig) && maySteer(store)) store.set("view tab", "rig"); // the motions must be read
    was = rig.state;
    name.textContent = rig.name;
    state.textContent = isCut(store) ? `Without a connection its state is not known. The last was: it ${stateOf(rig)}.` : `It ${stateOf(rig)}.`;
    moves.hidden = seen.hidden = !waits(rig);
    renew(moves, rig.moves.map((line) => make("li", {}, line)));
    free.checked = confirmed(store);
    const live = store.get("insertion live");
    const withdrawn = rig.motion === "retraction" && rig.state === "idle";
    retract.hidden = withdrawn || !(OVER.includes(rig.state) && live?.rig && live.periods);
  };
  free.addEventListener("change", () => store.set("view confirmed", free.checked ? motionsOf(store) : undefined));
  store.subscribe(["rig", ...STEERING, "view confirmed", "insertion live"], show);
  store.subscribe(STEERING, () => maySteer(store) || store.set("view confirmed", undefined)); // another page is in control
  store.subscribe(["check", "session", "job check"], () => renew(findings, inLines(store)));
}

// State of the rig with its reason, in words.
export function stateOf({ state, why, motion }) {
  const words = (motion === "retraction" && RETRACTION[state]) || STATES[state] || state;
  return `${words}${why && state !== "armed" ? `: ${why}` : ""}`;
}

export const isArmed = (store) => store.get("rig")?.state === "armed";
export const isChecking = (store) => ["waiting", "running"].includes(store.get("job check")?.state);
export const waits = (rig) => ["ready", "armed", "holding"].includes(rig.state) && rig.moves.length > 0;

// The motions that follow "go", of which insertion.
function motionsOf(store) {
  const { job, moves } = store.get("rig");
  return [job, ...moves].join("\n");
}

// Return whether the present motions are confirmed.
export const confirmed = (store) => Boolean(store.get("rig")) && store.get("view confirmed") === motionsOf(store);

// Progress of a check, then its problems, and all findings below.
function inLines(store) {
  const [job, found] = [store.get("job check"), store.get("check")];
  if (isChecking(store)) return [make("p", { role: "status" }, `Checking: ${job.text || "waits"} …`)];
  if (job?.state === "failed") return [make("p.bad", { role: "alert" }, `The check has failed: ${job.text}`)];
  if (!found) return [];
  const problems = found.findings.filter(({ problem }) => problem);
  const counted = problems.length ? `${problems.length} ${problems.length > 1 ? "problems" : "problem"}` : "no problem";
  const at = found.made ? ` at ${new Date(1000 * found.made).toLocaleTimeString([], { timeStyle: "short" })}` : "";
  if (found.moved) return [make("p.bad", { role: "status" }, `The check${at} is out of date: the rig has moved since, or has refused a motion. Check it again.`)];
  const of = isStale(store, found) ? ", for an earlier state of the scenario" : "";
  return [
    make("p", { role: "status" }, `The check${at} has found ${counted}${of}.`),
    make("ul", {}, ...problems.map((one) => make("li.bad", {}, inWords(one)))),
    make("details", {}, make("summary", {}, `All ${found.findings.length} findings`), make("ul", {}, ...found.findings.map((one) => make("li", {}, inWords(one))))),
  ];
}

const inWords = ({ part, item, found, problem }) => `${part}, ${item}: ${[found, problem].filter(Boolean).join("; ")}`;
