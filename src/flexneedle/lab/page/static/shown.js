// The shown state: the scene before an insertion, the running insertion, or a recorded one, at a period.
//   "view of": "scene", "live" or "first", as chosen by the user; undefined: the newest
//   "view newest": "live" or "first", the one that began, or was opened, last
//   "view searched": the strategy of the newest iteration of a search
//   "view period": the period that is shown; undefined: the newest
// An insertion that begins, and a recording that is opened, makes both undefined (store.js).

const RUNS = ["waiting", "planning", "ready", "running", "paused", "holding"];
const BEFORE = ["waiting", "planning", "ready"];
const PREPARED = ["preparing", "ready", "armed"]; // states of a rig
export const ENDED = ["stopped", "fault", "ended"]; // states of a rig that stands
const TARGET_KEYS = ["target.depth_mm", "target.lateral_mm", "target.lateral_z_mm"];
const SAME = 1e-3; // s, largest difference between times of the same period

// Return whether an insertion (message "insertion", or none) runs or waits.
export const runs = (live) => RUNS.includes(live?.state);

// Return whether an insertion or retraction on a rig is only prepared: nothing moves before it is started.
export function isPrepared(store) {
  const [live, rig] = [store.get("insertion live"), store.get("rig")];
  const insertion = runs(live) && Boolean(live.rig) && BEFORE.includes(live.state);
  return (insertion || retracts(store)) && PREPARED.includes(rig?.state) && !rig.begun;
}

// Return whether a retraction is prepared or runs.
export function retracts(store) {
  const rig = store.get("rig");
  return rig?.motion === "retraction" && rig.job !== null;
}

// Keys to subscribe to for the functions of this module.
export const SHOWN = [
  "view of", "view period", "view theme", "scene", "session", "draft", "insertion ", "rows ", "zones ", "shape ", "plan ",
  "iteration ", "job compare", "reach", "estimate",
];

// "scene", "live" or "first".
export function shownOf(store) {
  const [live, first] = [store.get("insertion live"), store.get("insertion first")];
  const chosen = store.get("view of");
  if (chosen === "scene" || (chosen === "live" && live) || (chosen === "first" && first)) return chosen;
  if (runs(live)) return "live";
  if (first && !(live && store.get("view newest") === "live")) return "first";
  const current = store.get("session")?.revision;
  return live && (!live.scene || live.scene.revision === current) ? "live" : "scene";
}

// Index of the period that is shown, or null before the first.
export function shownPeriod(store, of = shownOf(store)) {
  const count = store.get(`rows ${of}`)?.length ?? 0;
  if (!count) return null;
  return Math.min(store.get("view period") ?? Infinity, count - 1);
}

// Row of that period, or null.
export function shownRow(store, of = shownOf(store)) {
  return store.get(`rows ${of}`)?.[shownPeriod(store, of)] ?? null;
}

// Return whether the tip was measured at the period of a row.
export const isMeasured = (row) => Boolean(row?.measured?.every((part) => part !== null));

// Shape (paths, points, columns, values) of a kind, such as "needle", of the shown state; or null.
export function shownShape(store, kind, of = shownOf(store)) {
  const period = of === "scene" ? null : shownPeriod(store, of);
  const before = of === "scene" || (kind === "needle" && period === null); // of the insertion's first period
  return before ? store.get(`shape ${kind} scene`) ?? null : store.track(kind, of, period ?? Infinity);
}

// Time (s) from which the times of an insertion's rows are shown: a rig's clock begins long before its first period.
export function startOf(store, of) {
  return store.get(`insertion ${of}`)?.rig ? store.get(`rows ${of}`)?.[0]?.time ?? 0 : 0;
}

// The second recorded run, {name, row, shape(kind)}, at the same time after its first period as the shown one; or null. If the
// user chose the scene, no run is compared.
export function shownSecond(store) {
  const chosen = store.get("view of") === "scene" && ["live", "first"].some((of) => store.get(`insertion ${of}`));
  if (!store.get("insertion second") || chosen) return null;
  const of = shownOf(store);
  const [rows, row] = [store.get("rows second") ?? [], shownRow(store, of)];
  const since = row ? row.time - store.get(`rows ${of}`)[0].time : Infinity;
  const period = rows.findLastIndex(({ time }) => time - rows[0].time <= since + SAME);
  return { name: store.get("insertion second").name, row: rows[period] ?? null, shape: (kind) => store.track(kind, "second", period) };
}

// Scene of the shown state, or null before the first.
export function shownScene(store) {
  const of = shownOf(store);
  return (of === "scene" ? null : store.get(`insertion ${of}`)?.scene) ?? store.get("scene") ?? null;
}

// Position of the target (x, y, z), with a pending edit; or null.
export function shownTarget(store) {
  const of = shownOf(store);
  if (of !== "scene") return store.get(`insertion ${of}`).target;
  const scene = store.get("scene");
  if (!scene) return null;
  const draft = store.get("draft") ?? {};
  return TARGET_KEYS.map((key, axis) => draft[key] ?? scene.target[axis]);
}

// The other targets [{name, position}]; beside an insertion those that it does not have; none beside a recorded one.
export function otherTargets(store) {
  const of = shownOf(store);
  const { targets = [], target } = store.get("session") ?? {};
  if (of === "scene") return targets.filter(({ name }) => name !== target);
  const own = String(store.get(`insertion ${of}`).target);
  return of === "live" ? targets.filter(({ position }) => String(position) !== own) : [];
}

// The edit that moves the target to a point (x, y, z), to 0.01 mm; in the plane without z.
export function targetEdit(store, point) {
  const axes = store.get("scene").axes;
  const keys = TARGET_KEYS.slice(0, 1 + axes);
  return Object.fromEntries(keys.map((key, axis) => [key, Math.round(point[axis] * 100) / 100]));
}

// Keys to subscribe to for the next functions.
export const STEERING = ["clients", "welcome", "connection"];

// Return whether there is no connection to the server, although this page needs one.
export const isCut = (store) => ["connecting", "lost"].includes(store.get("connection"));

// Return why this client can neither be in control nor take control, or "".
export function whyNot(store) {
  const [clients, welcome] = [store.get("clients"), store.get("welcome")];
  if (isCut(store) || !clients) return "There is no connection to the server.";
  return clients.steering === null || clients.steering === welcome?.client ? "" : `Person ${clients.steering} is in control.`;
}

// Return whether this client is in control, or can take control.
export const maySteer = (store) => !whyNot(store);

// Enable a control of a client that may steer, under a condition; otherwise its title is the reason.
export function allow(store, control, condition = true) {
  const why = whyNot(store);
  control.dataset.title ??= control.title;
  Object.assign(control, { disabled: Boolean(why) || !condition, title: why || control.dataset.title });
}

// Return whether this client is in control.
export function steers(store) {
  const clients = store.get("clients");
  return Boolean(clients) && clients.steering !== null && clients.steering === store.get("welcome")?.client;
}

// Return whether the shown state can be edited: the scene before an insertion.
export const mayMove = (store) => maySteer(store) && shownOf(store) === "scene";

// The reach, if it belongs to the present scenario, or null; it is kept while only the target moves (protocol.py).
export function shownReach(store) {
  const reach = shownOf(store) === "scene" ? store.get("reach") : null;
  return reach && reach.revision >= store.get("session")?.reach_since ? reach : null;
}

// Return whether a plan or estimate belongs to an earlier state of the scenario.
export function isStale(store, result) {
  return Boolean(result) && result.revision !== store.get("session")?.revision;
}
