// Run an insertion: start, stop, pause, single periods, pace; arm a connected rig; disturb; decisions in words.

import { button, make } from "./dom.js";
import { followDecisions } from "./insertion/decisions.js";
import { disturbForm } from "./insertion/disturb.js";
import { rigForm } from "./insertion/rig.js";
import { inWords } from "./insertion/words.js";
import { maySteer, runs as isRunning } from "./shown.js";

const PACES = [0.25, 0.5, 1, 2, 5, 10, 20];
const SHOWN_BY = ["insertion live", "clients", "welcome", "rig"];
const BEFORE_IT = ["waiting", "planning"];
const NONE = "No insertion yet. “Insert” makes a plan and carries it out.";

export function mount(element, store, link) {
  const state = make("p", { role: "status" });
  const isPaused = () => store.get("insertion live")?.state === "paused";
  const start = button("Insert", () => link.ask({ type: "insert" }), { class: "primary", title: "On the virtual rig, in real time" });
  const slowly = button("Start paused", () => link.ask({ type: "insert", paused: true }));
  const stop = button("Stop", () => link.ask({ type: "stop" }), { class: "danger stop" });
  const pause = button("Pause", () => link.ask({ type: "pace", pace: pause.dataset.next === "go" ? Number(pace.value) : 0 }));
  const step = button("One period", () => link.ask({ type: "advance" }), { title: "Execute one control period" });
  const pace = make("select", { "aria-label": "Pace", change: () => isPaused() || link.ask({ type: "pace", pace: Number(pace.value) }) }); // paused: “Continue” takes it
  pace.append(...PACES.map((each) => make("option", { value: String(each) }, `${each}×`)));
  pace.value = "1";
  let focused = null;
  store.subscribe(SHOWN_BY, () => {
    focused = document.activeElement; // before the forms hide it
  });
  const [rig, disturb] = [rigForm(store, link), disturbForm(store, link)];
  const decisions = make("div.decisions");
  element.append(
    state,
    make("div.tools", { role: "toolbar", "aria-label": "Insertion" }, start, slowly, stop, pause, step, pace),
    rig, disturb, decisions,
  );
  followDecisions(decisions, store);

  store.subscribe(["insertion live", "rows live"], () => {
    const live = store.get("insertion live");
    const words = live ? inWords(live, store.get("rows live")) : NONE;
    if (state.textContent !== words) state.textContent = words; // a text that is set again is read out again
  });
  store.subscribe(SHOWN_BY, () => {
    const live = store.get("insertion live");
    const runs = isRunning(live);
    const [steers, real, paused] = [maySteer(store), Boolean(live?.rig), live?.state === "paused"];
    const signalled = steers && !BEFORE_IT.includes(live?.state); // before it moves it can only be stopped
    for (const each of [start, slowly]) Object.assign(each, { hidden: runs, disabled: !steers });
    stop.hidden = !runs;
    for (const each of [pause, step, pace]) each.hidden = !runs || real;
    pause.disabled = pace.disabled = disturb.disabled = !signalled;
    step.disabled = !signalled || !paused;
    pause.dataset.next = paused ? "go" : "pause";
    pause.textContent = paused ? "Continue" : "Pause";
    if (live?.pace && document.activeElement !== pace) pace.value = String(nearest(live.pace));
    disturb.hidden = !runs || real;
    if (element.contains(focused) && focused.matches(":disabled, [hidden], [hidden] *")) (runs ? stop : start).focus({ preventScroll: true });
  });
}

const nearest = (pace) => PACES.reduce((best, each) => (Math.abs(each - pace) < Math.abs(best - pace) ? each : best));
