// What moves, for views in two dimensions: {path, tone, width, alpha, dash, text, spread}, from back to front.

import { first, fresh, last, pathOfRows, ranksOf } from "../paths.js";
import { isStale, shownOf, shownRow, shownSecond, shownShape } from "../shown.js";

const STRATEGIES = ["manipulation", "steering"];
const STALE = 0.35;

export function partsOf(store, scene) {
  const of = shownOf(store);
  const shape = (kind) => shownShape(store, kind, of);
  const radius = scene.needle_radius_mm;
  const parts = [
    ...samples(store, of),
    { path: first(shape("channel")), tone: "--tissue", thick: 3 * radius, alpha: 0.5, text: "cut channel" },
    ...plans(store, of),
    ...tips(store, of),
    foreseen(store, of, shape),
    ...secondRun(store, radius),
    { path: first(shape("needle")), tone: "--needle", thick: 2 * radius, least: 2.5, text: "needle" },
    { path: first(shape("true")), tone: "--true", thick: 0.6 * radius, least: 1.25, text: "true needle" },
  ];
  return parts.filter(({ path }) => path);
}

// Sampled paths: the cheaper, the stronger.
function samples(store, of) {
  const strategy = store.get("session")?.strategy;
  const shape = of === "scene"
    ? fresh(store, `iteration ${strategy}`, `shape samples ${strategy}`) ?? null
    : shownShape(store, "samples", of);
  if (!shape) return [];
  const ranks = ranksOf(shape);
  const size = shape.points * shape.columns;
  return Array.from(ranks, (rank, at) => ({
    path: { ...shape, values: shape.values.subarray(at * size, (at + 1) * size) },
    tone: "--estimate", width: 1, alpha: 0.5 - 0.4 * rank, sampled: true,
    text: at === 0 ? `${shape.paths} sampled paths` : undefined,
  }));
}

function plans(store, of) {
  const chosen = store.get("session")?.strategy ?? STRATEGIES[0];
  if (of !== "scene") return [{ path: first(shownShape(store, "path", of) ?? store.get(`shape path ${chosen}`) ?? null), tone: "--plan", width: 1.5, text: "planned path" }];
  const estimate = store.get(`plan ${chosen}`) ? null : fresh(store, "estimate", "shape path scene");
  const other = STRATEGIES.find((name) => name !== chosen);
  const both = Boolean(store.get(`shape path ${other}`));
  const planned = (name) => ({
    path: first(store.get(`shape path ${name}`) ?? (name === chosen ? estimate : null) ?? null),
    tone: both ? `--${name}` : "--plan", width: 1.75, dash: name !== chosen,
    alpha: isStale(store, store.get(`plan ${name}`)) ? STALE : 1,
    text: both ? `path by ${name}` : "planned path",
  });
  return [planned(other), planned(chosen)];
}

function tips(store, of) {
  const row = of === "scene" ? null : shownRow(store, of);
  if (!row) return [];
  const rows = store.get(`rows ${of}`).slice(0, row.index + 1);
  return [
    { path: pathOfRows(rows, "estimate"), tone: "--estimate", width: 2, text: "estimated path of the tip", tip: true },
    { path: pathOfRows(rows, "true"), tone: "--true", width: 1.25, dash: true },
  ];
}

// The needle at the target: predicted with ± 2 sd during an insertion, the last of the plan before one.
function foreseen(store, of, shape) {
  const strategy = store.get("session")?.strategy;
  const sweep = () => fresh(store, `plan ${strategy}`, `shape sweep ${strategy}`) ?? fresh(store, "estimate", "shape sweep scene") ?? null;
  const path = of === "scene" ? last(sweep()) : first(shape("predicted"));
  const spread = path && path.columns > 3 ? 2 : 0;
  const text = spread ? "predicted needle ± 2 sd" : "needle at the target, planned";
  return { path, tone: "--predicted", width: 1.5, spread, text, predicted: true };
}

function secondRun(store, radius) {
  const second = shownSecond(store);
  if (!second) return [];
  const rows = second.row ? store.get("rows second").slice(0, second.row.index + 1) : [];
  return [
    { path: pathOfRows(rows, "estimate"), tone: "--second", width: 1.5 },
    { path: first(second.shape("needle")), tone: "--second", thick: 2 * radius, least: 2, text: "second run" },
  ];
}
