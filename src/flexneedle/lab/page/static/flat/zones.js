// Zones to avoid in a section: closed curves in which its plane cuts their surfaces and margins, and the least clearance.

import { clearanceIn } from "../zones.js";
import { disc, polyline, words } from "./pen.js";
import { across, lateral } from "./plane.js";
import { color } from "../theme.js";

const ALPHA = 0.4;

export function drawZones(pen, map, plane, zones) {
  for (const { name, surface, margin, offset } of zones) {
    const outlines = (of) => loopsOf(of, offset, plane).map((loop) => loop.map(([x, u]) => [map.toX(x), map.toY(u)]));
    const loops = outlines(surface);
    fill(pen, loops);
    for (const loop of loops) polyline(pen, closed(loop), { tone: "--zone", width: 1.25 });
    for (const loop of outlines(margin)) polyline(pen, closed(loop), { tone: "--zone", dash: true });
    if (loops.length) words(pen, name, middleOf(loops[0]), { tone: "--ink", base: "middle" });
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

// Closed curves [[x, u], …] in which a plane cuts a surface that is moved by an offset: each edge that it crosses is followed by
// the other one of the triangle to its left.
export function loopsOf({ points, triangles }, [dx, dy, dz], plane) {
  const at = (point) => [points[3 * point] + dx, points[3 * point + 1] + dy, points[3 * point + 2] + dz];
  const count = points.length / 3;
  const side = Float64Array.from({ length: count }, (_, point) => across(plane, ...at(point)));
  const next = new Map();
  for (let corner = 0; corner < triangles.length; corner += 3) {
    let [from, to] = [null, null];
    for (let k = 0; k < 3; k++) {
      const [one, other] = [triangles[corner + k], triangles[corner + ((k + 1) % 3)]];
      if (side[one] < 0 && side[other] >= 0) from = one * count + other;
      if (side[one] >= 0 && side[other] < 0) to = other * count + one;
    }
    if (from !== null) next.set(from, to);
  }
  const cut = (edge) => {
    const [one, other] = [Math.floor(edge / count), edge % count];
    const share = side[one] / (side[one] - side[other]);
    const [begin, end] = [at(one), at(other)];
    const [x, y, z] = begin.map((part, axis) => part + share * (end[axis] - part));
    return [x, lateral(plane, x, y, z)];
  };
  const loops = [];
  while (next.size) {
    const loop = [];
    for (let edge = next.keys().next().value; next.has(edge);) {
      loop.push(cut(edge));
      const after = next.get(edge);
      next.delete(edge);
      edge = after;
    }
    loops.push(loop);
  }
  return loops.sort((a, b) => b.length - a.length);
}

function fill(pen, loops) {
  pen.save();
  pen.fillStyle = color("--zone");
  pen.globalAlpha = ALPHA;
  pen.beginPath();
  for (const loop of loops) {
    for (const [at, [x, y]] of loop.entries()) at ? pen.lineTo(x, y) : pen.moveTo(x, y);
    pen.closePath();
  }
  pen.fill("evenodd");
  pen.restore();
}

const closed = (loop) => [...loop, loop[0]];

function middleOf(loop) {
  const [xs, ys] = [0, 1].map((axis) => loop.map((point) => point[axis]));
  return [xs, ys].map((parts) => (Math.min(...parts) + Math.max(...parts)) / 2);
}
