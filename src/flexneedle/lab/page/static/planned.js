// The plan, or its first estimate while the present scenario has no plan: the path of the tip, the needle at the target,
// and the roll at the start, for all views.

import { first, fresh, last, pointsIn } from "./paths.js";
import { isStale, shownRow, shownShape } from "./shown.js";

const STRATEGIES = ["manipulation", "steering"];
const strategyOf = (store) => store.get("session")?.strategy ?? STRATEGIES[0];

// Planned paths of the tip {chosen, other}, each {path, text, tone, stale} or null: of an insertion; before it, of the
// chosen strategy and of the other beside it. stale: it was planned for an earlier state of the scenario.
export function plannedPaths(store, of) {
  const own = of === "scene" ? null : first(shownShape(store, "path", of));
  if (own) return { chosen: { path: own, text: "planned path", tone: "--plan", stale: false }, other: null };
  const strategy = strategyOf(store);
  const beside = STRATEGIES.find((name) => name !== strategy);
  const otherPath = first(store.get(`shape path ${beside}`));
  const { shape, estimated } = present(store, "path");
  const path = first(shape ?? store.get(`shape path ${strategy}`));
  const text = estimated ? "first estimate" : otherPath ? `path by ${strategy}` : "planned path";
  return {
    chosen: path && { path, text, tone: otherPath ? `--${strategy}` : "--plan", stale: !shape },
    other: otherPath && { path: otherPath, text: `path by ${beside}`, tone: `--${beside}`, stale: isStale(store, store.get(`plan ${beside}`)) },
  };
}

// Sampled paths before an insertion: of the chosen strategy, or of the strategy that is searched during a comparison; or null.
export function sampledPaths(store) {
  const comparing = store.get("job compare")?.state === "running";
  const strategy = (comparing && store.get("view searched")) || strategyOf(store);
  return fresh(store, `iteration ${strategy}`, `shape samples ${strategy}`) ?? null;
}

// The needle at the target {path, text, spread}: predicted with its standard deviation (column 4) during an insertion,
// the last of the plan before one; path is null if there is none.
export function foreseen(store, of) {
  const { shape, estimated } = of === "scene" ? present(store, "sweep") : { shape: shownShape(store, "predicted", of) };
  const path = of === "scene" ? last(shape) : first(shape);
  if (path?.columns > 3) return { path, text: "predicted needle at the target ± 2 sd", spread: 2 };
  return { path, text: `needle at the target, ${estimated ? "first estimate" : "planned"}`, spread: 0 };
}

// Points [x, y, z] of the curve through which sections cut the zones: the planned needle at the target; of an insertion its needle
// and, beyond the tip, the planned path.
export function cutAlong(store, of) {
  const path = plannedPaths(store, of).chosen?.path;
  if (of === "scene") return pointsIn(foreseen(store, of).path ?? path);
  const needle = pointsIn(first(shownShape(store, "needle", of)));
  return [...needle, ...pointsIn(path).filter(([x]) => x > (needle.at(-1)?.[0] ?? -Infinity))];
}

// Roll (deg) at the shown period; before the first the plan's.
export function rollOf(store, of) {
  const row = of === "scene" ? null : shownRow(store, of);
  if (row) return row.roll_deg;
  const news = [store.get(`plan ${strategyOf(store)}`), store.get("estimate")];
  return news.find((each) => each && !isStale(store, each))?.roll_deg ?? 0;
}

// The shape of a kind of the present scenario's plan, or of its first estimate; undefined without one.
function present(store, kind) {
  const strategy = strategyOf(store);
  const planned = fresh(store, `plan ${strategy}`, `shape ${kind} ${strategy}`);
  if (planned) return { shape: planned, estimated: false };
  const shape = fresh(store, "estimate", `shape ${kind} scene`);
  return { shape, estimated: Boolean(shape) };
}
