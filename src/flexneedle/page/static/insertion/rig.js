// Arm the connected rig for one insertion, and start it there.

import { button, make } from "../dom.js";
import { maySteer } from "../shown.js";

const RUNS = ["waiting", "planning", "running", "paused"];
const STATES = { idle: "not armed", armed: "armed for one insertion", inserting: "inserting", held: "held" };

export function rigForm(store, link) {
  const [state, name] = [make("p", { role: "status" }), make("legend")];
  const free = make("input", { id: "rig-free", type: "checkbox" });
  const arm = button("Arm", () => link.ask({ type: "arm", armed: !store.get("rig")?.armed }));
  const insert = button("Insert on the rig", () => link.ask({ type: "insert", rig: true }), { class: "danger" });
  const form = make(
    "fieldset.rig", { hidden: true }, name, state,
    make("label.tools", { for: "rig-free" }, free, "I have checked that the needle's path is free and that I can see the rig."),
    make("div.tools", {}, arm, insert),
  );
  const show = () => {
    const [rig, runs] = [store.get("rig"), RUNS.includes(store.get("insertion live")?.state)];
    form.hidden = !rig || !store.get("welcome")?.rig;
    if (form.hidden) return;
    name.textContent = `Rig: ${rig.name}`;
    state.textContent = `It is ${STATES[rig.state] ?? rig.state}${rig.why ? `: ${rig.why}` : ""}.`;
    arm.textContent = rig.armed ? "Disarm" : "Arm";
    arm.disabled = !maySteer(store) || runs || !(rig.armed || free.checked);
    insert.disabled = !maySteer(store) || runs || !rig.armed;
    if (rig.state === "inserting") free.checked = false; // it is checked again before each insertion
  };
  free.addEventListener("change", show);
  store.subscribe(["rig", "welcome", "people", "insertion live"], show);
  return form;
}
