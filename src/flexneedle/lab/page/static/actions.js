// The action bar: plan, insert, stop, pause, pace; on a rig check, prepare, arm, insert. Below it what runs, in words.

import { button, make } from "./dom.js";
import { confirmed, isArmed, isChecking, stateOf, waits } from "./rig.js";
import { inWords } from "./insertion/words.js";
import { planWords } from "./plans/words.js";
import { ENDED, SHOWN, STEERING, allow, isCut, isPrepared, maySteer, retracts, runs as isRunning, shownOf } from "./shown.js";

const PACES = [0.25, 0.5, 1, 2, 5, 10, 20];
const SHOWN_BY = ["insertion live", ...STEERING, "rig", "job check", "view confirmed"];
const BEFORE_IT = ["waiting", "planning"];
const CUT = "There is no connection to the server, and what is shown may be out of date.";

export function mount(element, store, link) {
  const shows = (tab, request) => () => {
    store.set("view tab", tab);
    link.ask(request());
  };
  const plan = button("Plan", shows("plans", () => ({ type: "start", work: "plan" })), { "data-work": "plan" });
  const start = button("Insert", shows("insertion", () => ({ type: "insert" })), { class: "primary", title: "On the virtual rig, in real time" });
  const slowly = button("Start paused", shows("insertion", () => ({ type: "insert", paused: true })));
  const stop = button("Stop", () => link.ask({ type: "stop" }), { class: "stop" });
  const [pause, step, pace] = pacing(store, link);
  const steps = rigSteps(store, shows);
  const words = make("p.words", { role: "status" });
  element.append(make("div.tools", { role: "toolbar", "aria-label": "Actions" }, plan, ...steps, start, slowly, pause, step, pace, stop), words);

  let focused = null;
  store.subscribe(SHOWN_BY, () => {
    focused = document.activeElement; // before it is hidden
  });
  store.subscribe(SHOWN_BY, () => {
    const live = store.get("insertion live");
    const [withdraws, prepared, rig] = [retracts(store), isPrepared(store), store.get("rig")];
    const [steers, real, paused] = [maySteer(store), withdraws || Boolean(live?.rig), live?.state === "paused"];
    const runs = withdraws || isRunning(live);
    const signalled = steers && !BEFORE_IT.includes(live?.state); // before it moves it can only be stopped
    allow(store, plan, !(runs && real));
    for (const each of [start, slowly]) {
      allow(store, each);
      each.hidden = runs;
    }
    start.textContent = store.get("welcome")?.rig ? "Insert virtually" : "Insert";
    stop.disabled = !runs;
    stop.textContent = runs && isCut(store) ? "Stop: not connected" : prepared ? "End the preparation" : "Stop";
    stop.classList.toggle("danger", runs && !prepared && !(real && ENDED.includes(rig?.state)));
    for (const each of [pause, step, pace]) each.hidden = !runs || real;
    for (const each of [pause, pace]) allow(store, each, signalled);
    allow(store, step, signalled && paused);
    pause.dataset.next = paused ? "go" : "pause";
    pause.textContent = paused ? "Continue" : "Pause";
    if (live?.pace && document.activeElement !== pace) pace.value = String(nearest(live.pace));
    showSteps(steps, store, rig, runs);
    if (element.contains(focused) && focused.matches(":disabled, [hidden], [hidden] *")) (runs ? stop : start).focus({ preventScroll: true });
  });
  store.subscribe([...SHOWN, "rows live", "rig", "connection"], () => {
    const text = isCut(store) ? cutWords(store) : wordsOf(store);
    words.classList.toggle("bad", store.get("connection") === "lost");
    if (words.textContent !== text) words.textContent = words.title = text; // a text that is set again is read out again
  });
}

function pacing(store, link) {
  const isPaused = () => store.get("insertion live")?.state === "paused";
  const pause = button("Pause", () => link.ask({ type: "pace", pace: pause.dataset.next === "go" ? Number(pace.value) : 0 }));
  const step = button("One period", () => link.ask({ type: "advance" }), { title: "Execute one control period" });
  const pace = make("select", { "aria-label": "Pace", change: () => isPaused() || link.ask({ type: "pace", pace: Number(pace.value) }) }); // paused: “Continue” takes it
  pace.append(...PACES.map((each) => make("option", { value: String(each) }, `${each}×`)));
  pace.value = "1";
  return [pause, step, pace];
}

// Check → Prepare → Arm → Insert, and Retract → Arm → Retract the needle, in the tab of the rig.
function rigSteps(store, shows) {
  const step = (text, title, request) => button(text, shows("rig", request), { "data-step": text.toLowerCase(), title });
  const arm = () => ({ type: "arm", armed: !isArmed(store), job: store.get("rig").job });
  return [
    step("Check", "Compare the rig with its file and the scenario; nothing moves", () => ({ type: "check" })),
    step("Prepare", "Plan, open the rig, and measure the tip; nothing moves", () => ({ type: "prepare" })),
    step("Retract", "Read the position and show the motion that withdraws the needle along its path; nothing moves", () => ({ type: "retract" })),
    step("Arm", "For one start, once the motions are confirmed in the tab of the rig", arm),
    button("Insert on the rig", () => shows(retracts(store) ? "rig" : "insertion", () => ({ type: "go" }))(), { "data-step": "insert on the rig", title: "Motors are switched on, and the needle moves" }),
  ];
}

function showSteps([check, prepare, retract, arm, go], store, rig, runs) {
  const begun = Boolean(rig) && runs && (rig.begun || rig.state === "starting");
  const shown = Boolean(rig && store.get("welcome")?.rig);
  check.hidden = prepare.hidden = !shown || begun;
  retract.hidden = !shown || runs || rig.job !== null;
  arm.hidden = go.hidden = !shown || (begun && !waits(rig));
  if (!shown) return;
  for (const each of [check, prepare, retract]) allow(store, each, !(runs || rig.job !== null || isChecking(store)));
  for (const each of [arm, go]) each.classList.toggle("later", !waits(rig));
  arm.textContent = isArmed(store) ? "Disarm" : "Arm";
  allow(store, arm, waits(rig) && (isArmed(store) || confirmed(store)));
  go.textContent = retracts(store) ? "Retract the needle" : rig.begun ? "Continue" : "Insert on the rig";
  go.dataset.title = rig.begun ? "The needle moves on" : "Motors are switched on, and the needle moves";
  allow(store, go, isArmed(store));
  go.classList.toggle("danger", !go.disabled);
}

// Without a connection the state is unknown. The server stops or holds a rig that nobody controls.
function cutWords(store) {
  const live = store.get("insertion live");
  if (!store.get("welcome")) return "Connecting to the server.";
  if (!retracts(store) && !isRunning(live)) return CUT;
  return `${CUT} Stop cannot reach it${retracts(store) || live.rig ? ": use the rig's own stop." : "."}`;
}

// The insertion that runs or is shown, else the plan.
function wordsOf(store) {
  const live = store.get("insertion live");
  const shown = shownOf(store);
  const real = Boolean(live?.rig) && store.get("view of") !== "scene"; // its needle may still be in the tissue
  const of = isRunning(live) || (shown === "scene" && real) ? "live" : shown;
  const rig = store.get("rig");
  if (retracts(store) || (of === "live" && rig?.motion === "retraction" && !isRunning(live))) return `${rig.name} ${stateOf(rig)}.`;
  if (of === "scene") return planWords(store).map(([text]) => text).join(" ") || "No plan yet.";
  const insertion = store.get(`insertion ${of}`);
  const name = of === "first" ? `${insertion.name}: ` : "";
  return name + inWords(insertion, store.get(`rows ${of}`), of === "live" ? rig : null);
}

const nearest = (pace) => PACES.reduce((best, each) => (Math.abs(each - pace) < Math.abs(best - pace) ? each : best));
