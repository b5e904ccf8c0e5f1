// Paths from the shapes and rows of the store, for all views.

import { pathOf } from "./frames.js";
import { isStale } from "./shown.js";

// Value of `key`, if its message belongs to the present state of the scenario.
export const fresh = (store, news, key) => (isStale(store, store.get(news)) ? undefined : store.get(key));

// First and last path of a shape, or null.
export const first = (shape) => pathAt(shape, 0);
export const last = (shape) => pathAt(shape, (shape?.paths ?? 1) - 1);

// One path of a shape, or null; the same object for the same shape, so that it is drawn once.
const slices = new WeakMap();
export function pathAt(shape, index) {
  if (!shape || shape.paths === 0) return null;
  const known = slices.get(shape) ?? new Map();
  slices.set(shape, known);
  if (!known.has(index)) known.set(index, { ...shape, paths: 1, values: pathOf(shape, index) });
  return known.get(index);
}

// Points [x, y, z] of a path; none without one.
export function pointsIn(path) {
  return Array.from({ length: path?.points ?? 0 }, (_, at) => [...path.values.subarray(at * path.columns, at * path.columns + 3)]);
}

// Last point (x, y, z) of a path.
export function tipOf({ values, points, columns }) {
  const at = (points - 1) * columns;
  return [values[at], values[at + 1], values[at + 2]];
}

// Path of a position of rows, such as "estimate", or null.
export function pathOfRows(rows, key) {
  const known = rows.filter((row) => row?.[key]);
  if (known.length < 2) return null;
  return { points: known.length, paths: 1, columns: 3, values: Float32Array.from(known.flatMap((row) => row[key])) };
}

// Rank of each path by its cost, column 4 of its last point, from 0 (least) to 1; 0 without a cost.
export function ranksOf({ values, paths, points, columns }) {
  const ranks = new Float32Array(paths);
  if (columns < 4 || paths < 2) return ranks;
  const cost = (path) => values[((path + 1) * points - 1) * columns + 3];
  const order = Array.from({ length: paths }, (_, path) => path).sort((a, b) => cost(a) - cost(b));
  order.forEach((path, place) => {
    ranks[path] = place / (paths - 1);
  });
  return ranks;
}
