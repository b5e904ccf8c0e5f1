// A section: the plane of the depth x and a lateral direction, and how it is mapped to pixels.

import { FOOT, SIDE } from "./pen.js";

const SMALL = 1e-6; // mm

// Planes by name: {point, slope, e}; u of a point is its distance along e = (y, z) from point + slope · x.
export function planeOf(name, scene, target) {
  const flat = { point: [0, 0], slope: [0, 0] };
  if (name === "x–y") return { ...flat, e: [1, 0] };
  if (name === "x–z") return { ...flat, e: [0, 1] };
  const { point, slope } = scene.axis;
  const away = [0, 1].map((axis) => target[axis + 1] - point[axis] - slope[axis] * target[0]);
  const size = Math.hypot(...away);
  if (size < SMALL) return { point, slope, e: [1, 0] };
  const side = away[0] > SMALL || (Math.abs(away[0]) <= SMALL && away[1] > 0) ? 1 : -1; // stays as the target crosses the axis
  return { point, slope, e: away.map((part) => (side * part) / size) };
}

// Lateral coordinate of a point.
export function lateral({ point, slope, e }, x, y, z) {
  return e[0] * (y - point[0] - slope[0] * x) + e[1] * (z - point[1] - slope[1] * x);
}

// Distance of a point from the plane, along (−e₂, e₁).
export function across({ point, slope, e }, x, y, z) {
  return -e[1] * (y - point[0] - slope[0] * x) + e[0] * (z - point[1] - slope[1] * x);
}

// The function of the depth that is the distance from the plane of a curve of points [x, y, z] in the order of depth; 0 without points.
export function besideOf(plane, points) {
  const known = points.map(([x, y, z]) => [x, across(plane, x, y, z)]);
  return (depth) => {
    const next = known.findIndex(([x]) => x >= depth);
    if (next < 1) return known.at(next)?.[1] ?? 0; // before the first, or beyond the last
    const [[x0, w0], [x1, w1]] = known.slice(next - 1, next + 1);
    return w0 + ((w1 - w0) * (depth - x0)) / (x1 - x0);
  };
}

// The point at x, u that is as far from the plane as another.
export function lifted(plane, x, u, [fromX, fromY, fromZ]) {
  const { point, slope, e } = plane;
  const w = across(plane, fromX, fromY, fromZ);
  return [x, point[0] + slope[0] * x + u * e[0] - w * e[1], point[1] + slope[1] * x + u * e[1] + w * e[0]];
}

// "lateral ×3" where a mapping stretches the upward axis, else "".
export function stretchIn({ sx, sy }) {
  const times = Number((sy / sx).toFixed(1));
  return times === 1 ? "" : `lateral ×${times}`;
}

// Mapping of millimetres (right, up) to pixels: {toX, toY, fromX, fromY, sx, sy}. box: {left, right, half}; stretch:
// of the upward axis against the other.
export function mappingOf({ left, right, half }, width, height, stretch, [side, foot] = [SIDE, FOOT]) {
  const room = (height - foot) / 2;
  const sx = Math.min((width - side) / (right - left), room / half);
  const sy = Math.min(sx * stretch, room / half); // may be less than requested
  const middle = (width + side) / 2;
  const center = (left + right) / 2;
  return {
    sx, sy, room,
    toX: (x) => middle + (x - center) * sx,
    toY: (u) => room - u * sy,
    fromX: (px) => center + (px - middle) / sx,
    fromY: (py) => (room - py) / sy,
  };
}
