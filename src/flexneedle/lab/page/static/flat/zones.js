// Zones to avoid in a section, and the least clearance. Surfaces and margins are cut through the needle: at each depth as far from
// the plane as its curve, which so is in a zone, or in its margin, where it is drawn there. A silhouette is the whole zone.

import { clearanceIn } from "../zones.js";
import { disc, polyline, words } from "./pen.js";
import { across, besideOf, lateral } from "./plane.js";
import { color } from "../theme.js";

const [ALPHA, FAINT] = [0.4, 0.14];

// needle: points [x, y, z] of its curve in the order of depth; without points the plane cuts.
export function drawZones(pen, map, plane, zones, needle, { silhouettes }) {
  const beside = besideOf(plane, needle);
  for (const { name, surface, margin, offset } of zones) {
    const placed = (loops) => loops.map((loop) => loop.map(([x, u]) => [map.toX(x), map.toY(u)]));
    const outlines = (of) => placed(loopsOf(of, offset, plane, beside));
    const [loops, whole] = [outlines(surface), placed(silhouetteOf(surface, offset, plane))];
    if (silhouettes) fill(pen, whole, FAINT);
    fill(pen, loops, ALPHA);
    for (const loop of loops) polyline(pen, closed(loop), { tone: "--zone", width: 1.25 });
    for (const loop of outlines(margin)) polyline(pen, closed(loop), { tone: "--zone", dash: true });
    if (whole.length) words(pen, name, middleOf(loops[0] ?? whole[0]), { tone: "--ink", base: "middle" });
  }
}

// A line from the needle to the nearest zone, with the clearance; place: of a point (x, y, z).
export function drawNearest(pen, near, place) {
  const ends = [place(...near.needle), place(...near.surface)];
  polyline(pen, ends, { tone: "--ink", width: 1.25 });
  for (const end of ends) disc(pen, end, 2, { tone: "--ink" });
  const below = ends[0][1] >= ends[1][1]; // the needle is below the zone
  words(pen, clearanceIn(near), [ends[0][0], ends[0][1] + (below ? 16 : -8)], { tone: "--ink" });
}

// Closed curves [[x, u], …] in which a surface that is moved by an offset is cut, beside a plane as far as a function of the depth:
// each edge that is crossed is followed by the other one of the triangle to its left.
export function loopsOf({ points, triangles }, offset, plane, beside) {
  const at = movedBy(points, offset);
  const count = points.length / 3;
  const side = Float64Array.from({ length: count }, (_, point) => across(plane, ...at(point)) - beside(at(point)[0]));
  const next = new Map();
  for (let corner = 0; corner < triangles.length; corner += 3) {
    let [from, to] = [null, null];
    for (let k = 0; k < 3; k++) {
      const [one, other] = [triangles[corner + k], triangles[corner + ((k + 1) % 3)]];
      if (side[one] < 0 && side[other] >= 0) from = one * count + other;
      if (side[one] >= 0 && side[other] < 0) to = other * count + one;
    }
    if (from !== null) next.set(from, [to]);
  }
  const cut = (edge) => {
    const [one, other] = [Math.floor(edge / count), edge % count];
    const share = side[one] / (side[one] - side[other]);
    const [begin, end] = [at(one), at(other)];
    const [x, y, z] = begin.map((part, axis) => part + share * (end[axis] - part));
    return [x, lateral(plane, x, y, z)];
  };
  return chained(next).map((loop) => loop.map(cut));
}

// Closed curves [[x, u], …] around the triangles of a surface that face one side of the plane: its silhouette.
function silhouetteOf({ points, triangles }, offset, plane) {
  const at = movedBy(points, offset);
  const count = points.length / 3;
  const seen = Array.from({ length: count }, (_, point) => [at(point)[0], lateral(plane, ...at(point))]);
  const edges = new Set();
  for (let corner = 0; corner < triangles.length; corner += 3) {
    const [a, b, c] = triangles.slice(corner, corner + 3);
    const [[ax, au], [bx, bu], [cx, cu]] = [seen[a], seen[b], seen[c]];
    if ((bx - ax) * (cu - au) <= (cx - ax) * (bu - au)) continue;
    for (const [from, to] of [[a, b], [b, c], [c, a]]) if (!edges.delete(to * count + from)) edges.add(from * count + to);
  }
  const next = new Map();
  for (const edge of edges) {
    const from = Math.floor(edge / count);
    next.set(from, [...(next.get(from) ?? []), edge % count]);
  }
  return chained(next).map((loop) => loop.map((point) => seen[point]));
}

// Closed chains of keys, the longest first; next: the keys that follow each one.
function chained(next) {
  const loops = [];
  for (const begin of next.keys()) {
    const loop = [];
    for (let at = begin; next.get(at).length; at = next.get(at).pop()) loop.push(at);
    if (loop.length) loops.push(loop);
  }
  return loops.sort((a, b) => b.length - a.length);
}

const movedBy = (points, [dx, dy, dz]) => (point) => [points[3 * point] + dx, points[3 * point + 1] + dy, points[3 * point + 2] + dz];

function fill(pen, loops, alpha) {
  pen.save();
  pen.fillStyle = color("--zone");
  pen.globalAlpha = alpha;
  pen.beginPath();
  for (const loop of loops) {
    for (const [at, [x, y]] of loop.entries()) at ? pen.lineTo(x, y) : pen.moveTo(x, y);
    pen.closePath();
  }
  pen.fill();
  pen.restore();
}

const closed = (loop) => [...loop, loop[0]];

function middleOf(loop) {
  const [xs, ys] = [0, 1].map((axis) => loop.map((point) => point[axis]));
  return [xs, ys].map((parts) => (Math.min(...parts) + Math.max(...parts)) / 2);
}
