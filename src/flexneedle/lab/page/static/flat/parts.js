// Moving parts of views in two dimensions: {path, tone, width, alpha, dash, text, spread}, from back to front.

import { first, pathAt, pathOfRows, ranksOf } from "../paths.js";
import { foreseen, plannedPaths, sampledPaths } from "../planned.js";
import { regionEntries } from "../sensors.js";
import { isMeasured, shownOf, shownRow, shownSecond, shownShape } from "../shown.js";

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
    { ...foreseen(store, of), tone: "--predicted", width: 1.5, predicted: true },
    ...secondRun(store, radius),
    { path: first(shape("needle")), tone: "--needle", thick: 2 * radius, least: 2.5, text: "needle" },
    { path: first(shape("true")), tone: "--true", thick: 0.6 * radius, least: 1.25, text: "true needle" },
  ];
  return parts.filter(({ path }) => path);
}

// Sampled paths: the cheaper, the stronger.
function samples(store, of) {
  const shape = of === "scene" ? sampledPaths(store) : shownShape(store, "samples", of);
  if (!shape) return [];
  const ranks = ranksOf(shape);
  return Array.from(ranks, (rank, at) => ({
    path: pathAt(shape, at),
    tone: "--estimate", width: 1, alpha: 0.5 - 0.4 * rank, sampled: true,
    text: at === 0 ? `${shape.paths} sampled paths` : undefined,
  }));
}

function plans(store, of) {
  const { chosen, other } = plannedPaths(store, of);
  const part = (planned, dash) => ({ ...planned, width: 1.75, dash, alpha: planned.stale ? STALE : 1 });
  return [other && part(other, true), chosen && part(chosen, false)].filter(Boolean);
}

function tips(store, of) {
  const row = of === "scene" ? null : shownRow(store, of);
  if (!row) return [];
  const rows = store.get(`rows ${of}`).slice(0, row.index + 1);
  return [
    { path: pathOfRows(rows, "estimate"), tone: "--estimate", width: 2, text: "estimated path of the tip", tip: true },
    { path: pathOfRows(rows, "true"), tone: "--true", width: 1.25, dash: true, text: "true path of the tip" },
  ];
}

// Entries of the legend for the measured tip, if one was measured until the shown period, and for the region of the tip.
export function measuredEntries(store) {
  const row = shownRow(store);
  const some = row && store.get(`rows ${shownOf(store)}`).slice(0, row.index + 1).some(isMeasured);
  return [...(some ? [{ text: "measured tip", tone: "--measured", cross: true }] : []), ...regionEntries(store)];
}

function secondRun(store, radius) {
  const second = shownSecond(store);
  if (!second) return [];
  const rows = second.row ? store.get("rows second").slice(0, second.row.index + 1) : [];
  return [
    { path: pathOfRows(rows, "estimate"), tone: "--second", width: 1.5 },
    { path: first(second.shape("needle")), tone: "--second", thick: 2 * radius, least: 2, text: `run ${second.name}` },
  ];
}

// Entries of the legend of parts with a text, and of the reach.
export function entriesOf(parts, reached) {
  const entries = parts.filter(({ text }) => text).map(({ text, tone, dash, thick, sampled, spread, cross }) => ({
    text, tone, form: cross ? "cross" : dash ? "dashed" : thick ? "thick" : sampled ? "thin" : spread ? "area" : "line",
  }));
  return [...(reached ? [{ text: "reach", tone: "--reach", form: "area" }] : []), ...entries];
}
