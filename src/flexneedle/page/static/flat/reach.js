// The reach in a section: where its outlines, or its strip, cut the plane.

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

// [[x, u]] where an edge crosses the plane, if it does.
function cutOf(plane, a, b) {
  const [before, after] = [across(plane, ...a), across(plane, ...b)];
  if (before === after || (before > 0 && after > 0) || (before < 0 && after < 0)) return [];
  const share = before / (before - after);
  const [u, v] = [lateral(plane, ...a), lateral(plane, ...b)];
  return [[a[0] + share * (b[0] - a[0]), u + share * (v - u)]];
}

// Whether the strip of a reach is in a section's plane.
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
