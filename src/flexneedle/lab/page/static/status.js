// The bar at the bottom: connection, who is connected and in control, work with progress and cancel, refusals in words.

import { button, make, renew } from "./dom.js";
import { waits } from "./rig.js";
import { ENDED, isPrepared, isStale } from "./shown.js";

const CONNECTIONS = {
  connecting: "Connecting…",
  open: "Connected",
  lost: "No connection; trying again…",
};
const JOBS = {
  needle: "Needle", estimate: "First estimate", plan: "Plan", compare: "Both strategies", reach: "Reach",
  insertion: "Insertion", retraction: "Retraction", check: "Check of the rig", recording: "Recorded run", study: "Study", row: "Computing again",
  save: "Saving",
};
const CONTROL = {
  take: "Needed to change the scenario, plan and insert. Anyone can stop an insertion.",
  release: "Lets another page take control. On a rig, an insertion is then held; a retraction, a start or a preparation is ended.",
  over: "Control goes from the other page to this one at once. On a rig, nothing moves before its motions are confirmed here.",
};
const MOTIONS = ["insertion", "retraction"];
const OWN_END = [...MOTIONS, "save"]; // not cancelled: a motion is stopped, and a run is saved completely
const SHOWN_FOR = 12_000; // ms
const LONG = 5; // s
const SHORT = 1_000; // ms: work that ends sooner is not shown

export function mount(element, store, link) {
  const connection = make("span.connection", { role: "status" });
  const steering = make("span.steering");
  const jobs = make("span.jobs");
  const refusals = make("div.refusals", { role: "alert" });
  element.append(refusals, make("div.status-line", {}, connection, steering, jobs));

  store.subscribe(["connection", "connection reason"], () => showConnection(connection, store));
  followSteering(steering, store, link);
  store.subscribe(["session"], () => showTitle(store.get("session")));
  followJobs(jobs, store, link);
  followRefusals(refusals, store);
}

function showConnection(element, store) {
  const [state, reason] = [store.get("connection"), store.get("connection reason")];
  const why = state === "lost" && reason ? ` (${reason})` : "";
  element.dataset.state = state;
  element.replaceChildren(make("span.lamp", { "aria-hidden": "true" }), `${CONNECTIONS[state]}${why}`);
}

function showTitle(session) {
  const title = session ? `${session.values.name} · seed ${session.seed}` : "";
  document.getElementById("title").textContent = title;
  document.title = session ? `${session.values.name} – flexneedle` : "flexneedle";
}

// The client in control, and a button that takes or releases control and keeps the focus.
function followSteering(element, store, link) {
  let [mine, others] = [false, false];
  const words = make("span", { "aria-live": "polite" });
  const change = button("", () => link.ask({ type: "steer", take: !mine, ...(others ? { over: store.get("clients").steering } : {}) }));
  element.append(words, change);
  store.subscribe(["clients", "welcome", "connection", "rig"], () => {
    const [clients, welcome] = [store.get("clients"), store.get("welcome")];
    element.hidden = !clients || !welcome || store.get("connection") !== "open";
    if (element.hidden) return;
    mine = clients.steering === welcome.client;
    others = !mine && clients.steering !== null;
    renew(words, [make("span", {}, inControl(clients, welcome.client))]);
    const [text, title] = mine ? ["Release control", CONTROL.release] : others ? [`Take over${lossOf(store.get("rig"))}`, CONTROL.over] : ["Take control", CONTROL.take];
    if (change.textContent !== text) Object.assign(change, { textContent: text, title });
  });
}

// Effect of a take-over on an insertion on the rig, as the end of the button's text: whoever confirmed its motions has lost control.
function lossOf(rig) {
  if (!rig || rig.job === null || ENDED.includes(rig.state)) return "";
  if (rig.motion === "retraction" && (rig.begun || rig.state === "starting")) return " and stop the retraction";
  if (rig.state === "starting") return " and stop the insertion"; // motors are being switched on
  return rig.begun ? " and hold the needle" : " and end the preparation";
}

// The number of this page is shown if there are others, since refusals and stops name people by number.
function inControl({ clients, steering }, own) {
  const [alone, mine] = [clients === 1, steering === own];
  const all = alone ? "1 person connected" : `${clients} people connected, you are person ${own}`;
  return `${all}, ${steering === null ? "nobody is" : mine ? "you are" : `person ${steering} is`} in control`;
}

// Work that takes longer than a second has a bar; a failure stays until the next job of its kind begins, the refusal of an insertion
// until a later plan reaches the target.
function followJobs(element, store, link) {
  const entries = new Map(); // by kind
  store.subscribe(["job ", "rig", "insertion live", "plan "], () => {
    const kinds = new Set([...entries.keys(), ...store.keys("job ").map((key) => key.slice(4))]);
    for (const kind of kinds) change(kind, isSettled(store, kind) ? undefined : store.get(`job ${kind}`));
  });
  function change(kind, job) {
    const earlier = entries.get(kind);
    const runs = job?.state === "running" || job?.state === "waiting";
    if (earlier && (!job || earlier.job !== job.job || !(runs || job.state === "failed"))) remove(kind);
    if (!job || !(runs || job.state === "failed")) return;
    const entry = entries.get(kind) ?? begin(kind, job);
    update(entry, job);
    if (job.state === "failed") element.append(entry.element);
  }
  function begin(kind, { job }) {
    const bar = make("progress", { max: "1", "aria-label": `Progress: ${JOBS[kind]}` });
    const text = make("span");
    const cancel = button("Cancel", () => link.ask({ type: "cancel", job }), { "aria-label": `Cancel: ${JOBS[kind]}` });
    const entry = { job, kind, bar, text, cancel, begun: performance.now(), words: "", counts: false, element: make("span.job", {}, text, bar, cancel) };
    entry.timer = setTimeout(() => element.append(entry.element), SHORT);
    entry.clock = setInterval(() => tell(entry), 1000);
    entries.set(kind, entry);
    return entry;
  }
  function update(entry, job) {
    const { kind, text, bar, cancel } = entry;
    const failed = job.state === "failed";
    const rig = store.get("rig");
    if (kind === rig?.motion && isPrepared(store)) entry.words = `${JOBS[kind]}: ${{ preparing: "being prepared", armed: "armed" }[rig.state] ?? "prepared"}, nothing moves`;
    else if (kind === "insertion" && rig?.begun && waits(rig)) entry.words = `Insertion: held, ${job.text}`;
    else entry.words = job.text ? `${JOBS[kind]}: ${job.text}` : `${JOBS[kind]}${failed ? " failed" : "…"}`;
    entry.counts = !failed && (job.share ?? null) === null;
    tell(entry);
    text.classList.toggle("bad", failed);
    bar.hidden = failed;
    cancel.hidden = failed || OWN_END.includes(kind);
    if ((job.share ?? null) === null) bar.removeAttribute("value");
    else bar.value = job.share;
  }
  // Without a share, the time since its beginning: it shows that slow work continues.
  function tell({ words, counts, text, begun }) {
    const seconds = Math.floor((performance.now() - begun) / 1000);
    text.textContent = text.title = counts && seconds >= LONG ? `${words} (${seconds} s)` : words;
  }
  function remove(kind) {
    const { timer, clock, element: shown } = entries.get(kind);
    clearTimeout(timer);
    clearInterval(clock);
    shown.remove();
    entries.delete(kind);
  }
}

// Return whether an insertion was refused, and a later plan reaches the target.
function isSettled(store, kind) {
  if (kind !== "insertion" || store.get("insertion live")?.state !== "refused") return false;
  const refused = store.get("job insertion")?.job ?? Infinity;
  const later = ["plan", "compare"].map((each) => store.get(`job ${each}`)).some((job) => job?.state === "done" && job.job > refused);
  const plan = store.get(`plan ${store.get("session")?.strategy}`);
  return later && Boolean(plan?.reached) && !isStale(store, plan);
}

// The newest refusals, each for some seconds or until it is closed; the refusal of a value until the next accepted change.
function followRefusals(element, store) {
  let newest = 0;
  store.subscribe(["session"], () => {
    for (const each of element.querySelectorAll(".refusal:not([data-keys=''])")) each.remove();
  });
  store.subscribe(["refusals"], () => {
    for (const refusal of store.get("refusals") ?? []) {
      if (refusal.number <= newest) continue;
      newest = refusal.number;
      show(refusal);
    }
  });
  function show({ reason, problems, action }) {
    const keys = Object.keys(problems).join();
    if (keys && element.lastChild?.dataset.keys === keys) element.lastChild.remove(); // for example during a drag
    const close = button("Close", () => shown.remove());
    const act = action && button(action.text, () => {
      shown.remove();
      action.call();
    });
    const shown = make("div.refusal", { "data-keys": keys }, make("p", {}, reason), ...(act ? [act] : []), close);
    element.append(shown);
    while (element.children.length > 3) element.firstChild.remove();
    if (!action) setTimeout(() => shown.remove(), SHOWN_FOR);
  }
}
