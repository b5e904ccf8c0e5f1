// The reach in a section: the cut of its outlines, or of its strip, with the plane.

import { across, lateral } from "./plane.js";

const NEAR = 0.02; // rad between the strip's plane and a section of the same

// Points [x, u] of a closed outline in the plane, or null where there is none.
export function reachIn(plane, reach, outlines) {
  const cuts = outlines ? cutsOf(plane, outlines) : [];
  const spans = cuts.length > 1 ? cuts : stripOf(plane, reach);
  if (spans.length < 2) return null;
  return [...spans.map(({ low }) => low), ...spans.map(({ high }) => high).reverse()];
}

function cutsOf(plane, { paths, points, columns, values }) {
  const spans = [];
  for (let path = 0; path < paths; path++) {
    const corners = Array.from({ length: points }, (_, at) => values.subarray((path * points + at) * columns, (path * points + at) * columns + 3));
    const found = corners.flatMap((corner, at) => cutOf(plane, corner, corners[(at + 1) % points])).sort(([, u], [, v]) => u - v);
    if (found.length > 1) spans.push({ low: found[0], high: found.at(-1) });
  }
  return spans;
}

// [[x, u]] of the crossing of an edge with the plane, if any.
function cutOf(plane, a, b) {
  const [before, after] = [across(plane, ...a), across(plane, ...b)];
  if (before === after || (before > 0 && after > 0) || (before < 0 && after < 0)) return [];
  const share = before / (before - after);
  const [u, v] = [lateral(plane, ...a), lateral(plane, ...b)];
  return [[a[0] + share * (b[0] - a[0]), u + share * (v - u)]];
}

// Points [x, y, z] of the outline at a depth x (mm): in each direction between the ends found next above and below; none
// beyond the deepest one.
export function reachAt(depth, { paths, points, columns, values }) {
  const end = (path, at) => values.subarray((path * points + at) * columns, (path * points + at) * columns + 3);
  const found = [];
  for (let at = 0; at < points; at++) {
    const below = Array.from({ length: paths }, (_, path) => path).findIndex((path) => path > 0 && end(path - 1, at)[0] <= depth && depth <= end(path, at)[0]);
    if (below < 0) continue;
    const [a, b] = [end(below - 1, at), end(below, at)];
    const share = b[0] > a[0] ? (depth - a[0]) / (b[0] - a[0]) : 1;
    found.push([0, 1, 2].map((axis) => a[axis] + share * (b[axis] - a[axis])));
  }
  return found;
}

// Return whether the strip of a reach is in a section's plane.
export function isIn({ e }, { angle_deg: angle }) {
  const cosine = e[0] * Math.cos((angle * Math.PI) / 180) + e[1] * Math.sin((angle * Math.PI) / 180);
  return 1 - Math.abs(cosine) <= NEAR ** 2;
}

function stripOf(plane, reach) {
  if (!isIn(plane, reach)) return [];
  const { low, high } = reach;
  const placed = (point) => [point[0], lateral(plane, ...point)];
  return low.map((end, at) => ({ low: placed(end), high: placed(high[at]) }));
}
