// The insertion: its state or outcome, the load on the tissue beside opened runs, disturbances, and the decisions in words.

import { make } from "./dom.js";
import { followDecisions } from "./insertion/decisions.js";
import { disturbForm } from "./insertion/disturb.js";
import { followSensors } from "./insertion/sensors.js";
import { inWords } from "./insertion/words.js";
import { loadTable } from "./load.js";
import { STEERING, allow, isCut, runs } from "./shown.js";

const SHOWN = ["live", "first", "second"];
const NONE = "No insertion yet. “Insert” makes a plan and carries it out.";

export function mount(element, store, link) {
  const state = make("p.outcome");
  const disturb = disturbForm(store, link);
  const load = make("div");
  const decisions = make("div.decisions");
  const sensors = make("div");
  element.append(state, load, disturb, sensors, decisions);
  followSensors(sensors, store);
  followDecisions(decisions, store);
  store.subscribe(["insertion live", "rows live", "rig", "connection"], () => {
    const live = store.get("insertion live");
    const last = runs(live) && isCut(store) ? "Before the connection was lost: " : "";
    state.textContent = live ? last + inWords(live, store.get("rows live"), store.get("rig")) : NONE;
  });
  store.subscribe(["insertion "], () => load.replaceChildren(...loadTable(SHOWN.map((of) => store.get(`insertion ${of}`)))));
  store.subscribe(["insertion live", ...STEERING], () => {
    const live = store.get("insertion live");
    disturb.hidden = !runs(live) || Boolean(live.rig);
    allow(store, disturb, !["waiting", "planning"].includes(live?.state));
  });
}
