// The connected rig: check it, prepare an insertion, arm it once its motions are confirmed, and start it.

import { button, make, renew } from "../dom.js";
import { isStale, maySteer, runs } from "../shown.js";

const STATES = {
  idle: "is not in use", preparing: "is being prepared: the path is planned, the devices are opened; nothing moves",
  ready: "is ready; nothing moves before it is armed and started", armed: "is armed for one start",
  starting: "starts: motors are switched on, the needle is rolled as the plan begins", inserting: "inserts",
  holding: "holds: the needle rests where it is", stopped: "was stopped", fault: "has a fault",
  ended: "is at rest; the record is being written",
};

export function rigForm(store, link) {
  const [state, name] = [make("p", { role: "status" }), make("legend")];
  const check = button("Check", () => link.ask({ type: "check" }), { title: "Compare the rig with its file and the scenario; nothing moves" });
  const prepare = button("Prepare", () => link.ask({ type: "prepare" }), { title: "Plan, open the rig, and measure the tip; nothing moves" });
  const [findings, moves] = [make("div.findings"), make("ul.moves", { "aria-label": "Motions" })];
  const free = make("input", { id: "rig-free", type: "checkbox" });
  const seen = make("label.tools", { for: "rig-free" }, free, "I have read the motions, their path is free, and I can see the rig and reach its emergency stop.");
  const arm = button("Arm", () => link.ask({ type: "arm", armed: !isArmed(store), job: store.get("rig").job }));
  const go = button("Insert on the rig", () => link.ask({ type: "go" }), { class: "danger" });
  const form = make(
    "fieldset.rig", { hidden: true }, name, state, make("div.tools", {}, check, prepare), findings, moves, seen,
    make("div.tools", {}, arm, go),
  );
  let shownMoves = "";
  const show = () => {
    const [rig, steers, busy] = [store.get("rig"), maySteer(store), runs(store.get("insertion live"))];
    form.hidden = !rig || !store.get("welcome")?.rig;
    if (form.hidden) return;
    const waits = ["ready", "armed", "holding"].includes(rig.state) && rig.moves.length > 0;
    name.textContent = `Rig: ${rig.name}`;
    state.textContent = `It ${STATES[rig.state] ?? rig.state}${rig.why ? `: ${rig.why}` : ""}.`;
    check.hidden = prepare.hidden = rig.job !== null;
    check.disabled = prepare.disabled = !steers || busy || isChecking(store);
    for (const each of [moves, seen, arm, go]) each.hidden = !waits;
    if (rig.moves.join() !== shownMoves) { // the confirmed motions have changed
      shownMoves = rig.moves.join();
      free.checked = false;
      moves.replaceChildren(...rig.moves.map((line) => make("li", {}, line)));
    }
    if (rig.state !== "armed" && go.dataset.was === "armed") free.checked = false;
    go.dataset.was = rig.state;
    arm.textContent = isArmed(store) ? "Disarm" : "Arm";
    arm.disabled = !steers || !(isArmed(store) || free.checked);
    go.textContent = rig.begun ? "Continue" : "Insert on the rig";
    go.disabled = !steers || !isArmed(store);
  };
  free.addEventListener("change", show);
  store.subscribe(["rig", "welcome", "clients", "insertion live", "job check"], show);
  store.subscribe(["check", "session", "job check"], () => renew(findings, inLines(store)));
  return form;
}

const isArmed = (store) => store.get("rig")?.state === "armed";
const isChecking = (store) => ["waiting", "running"].includes(store.get("job check")?.state);

// Progress of a check, then its problems, and all findings below.
function inLines(store) {
  const [job, found] = [store.get("job check"), store.get("check")];
  if (isChecking(store)) return [make("p", { role: "status" }, `Checking: ${job.text || "waits"} …`)];
  if (job?.state === "failed") return [make("p.bad", { role: "alert" }, `The check has failed: ${job.text}`)];
  if (!found) return [];
  const problems = found.findings.filter(({ problem }) => problem);
  const counted = problems.length ? `${problems.length} ${problems.length > 1 ? "problems" : "problem"}` : "no problem";
  const of = isStale(store, found) ? ", for an earlier state of the scenario" : "";
  return [
    make("p", { role: "status" }, `The check has found ${counted}${of}.`),
    make("ul", {}, ...problems.map((one) => make("li.bad", {}, inWords(one)))),
    make("details", {}, make("summary", {}, `All ${found.findings.length} findings`), make("ul", {}, ...found.findings.map((one) => make("li", {}, inWords(one))))),
  ];
}

const inWords = ({ part, item, found, problem }) => `${part}, ${item}: ${[found, problem].filter(Boolean).join("; ")}`;
