// Drawing with the pen of a canvas: paths of shapes, grid, texts.

import { color } from "../theme.js";

const FONT = "11px system-ui, 'DejaVu Sans', sans-serif";
export const SIDE = 30; // px, of the labels on the left
export const FOOT = 18; // of those below
const CLOSEST = 44; // px between two labels
const CROSS = 3.5; // from its middle along each axis, px
const STEPS = [0.5, 1, 2, 5, 10, 20, 50, 100];

// Points [px, py] of a path; place: function of x, y, z. It is called for thousands of points a paint.
export function pointsOf({ points, columns, values }, place) {
  const placed = new Array(points);
  for (let at = 0, k = 0; at < points; at++, k += columns) placed[at] = place(values[k], values[k + 1], values[k + 2]);
  return placed;
}

export function polyline(pen, points, { tone, width = 1, alpha = 1, dash = false }) {
  pen.save();
  pen.strokeStyle = color(tone);
  [pen.globalAlpha, pen.lineWidth, pen.lineJoin] = [alpha, width, "round"];
  pen.setLineDash(dash ? [5, 3] : []);
  pen.beginPath();
  for (const point of points) pen.lineTo(point[0], point[1]);
  pen.stroke();
  pen.restore();
}

export function area(pen, points, tone, alpha) {
  pen.save();
  pen.fillStyle = color(tone);
  pen.globalAlpha = alpha;
  pen.beginPath();
  for (const [x, y] of points) pen.lineTo(x, y);
  pen.fill();
  pen.restore();
}

// radius: or two, across and up, of an ellipse.
export function disc(pen, [x, y], radius, { tone, alpha = 1, open = false, width = 1.5 }) {
  const [across, up = across] = [radius].flat();
  pen.save();
  pen.globalAlpha = alpha;
  pen.fillStyle = pen.strokeStyle = color(tone);
  pen.lineWidth = width;
  pen.beginPath();
  pen.ellipse(x, y, across, up, 0, 0, 2 * Math.PI);
  if (open) pen.stroke();
  else pen.fill();
  pen.restore();
}

export function cross(pen, [x, y], { tone }) {
  const ends = (side) => [-CROSS, CROSS].map((far) => [x + far, y + side * far]);
  for (const side of [-1, 1]) polyline(pen, ends(side), { tone, width: 1.25 });
}

export function words(pen, text, [x, y], { tone = "--quiet", align = "center", base = "alphabetic" } = {}) {
  pen.font = FONT;
  pen.fillStyle = color(tone);
  [pen.textAlign, pen.textBaseline] = [align, base];
  pen.fillText(text, x, y);
}

// Width of a text, px.
export function widthOf(pen, text) {
  pen.font = FONT;
  return pen.measureText(text).width;
}

// Clip to the grid: a needle's shaft to the left of it would cross the labels.
export function inside(pen, width, height, draw) {
  pen.save();
  pen.beginPath();
  pen.rect(SIDE, 0, width - SIDE, height - FOOT);
  pen.clip();
  draw();
  pen.restore();
}

// Grid lines with labels in mm along both axes; a mapping of plane.js; names of both axes.
export function grid(pen, map, width, height, [across, up]) {
  const bottom = height - FOOT;
  const [left, right] = [map.fromX(SIDE), map.fromX(width)];
  const [low, high] = [map.fromY(bottom), map.fromY(0)];
  for (const x of ticks(left, right, map.sx)) {
    polyline(pen, [[map.toX(x), 0], [map.toX(x), bottom]], { tone: "--grid" });
    if (map.toX(x) + widthOf(pen, minus(x)) / 2 <= width) words(pen, minus(x), [map.toX(x), height - 5]);
  }
  for (const u of ticks(low, high, map.sy)) {
    polyline(pen, [[SIDE, map.toY(u)], [width, map.toY(u)]], { tone: "--grid" });
    if (map.toY(u) > 16) words(pen, minus(u), [SIDE - 4, map.toY(u)], { align: "right", base: "middle" });
  }
  words(pen, across, [width - 4, bottom - 4], { align: "right" });
  words(pen, up, [SIDE + 4, 11], { align: "left" });
}

function ticks(low, high, scale) {
  const step = STEPS.find((each) => each * scale >= CLOSEST) ?? STEPS.at(-1);
  const from = Math.ceil(low / step);
  return Array.from({ length: Math.max(0, Math.floor(high / step) - from + 1) }, (_, at) => (from + at) * step);
}

const minus = (number) => String(number).replace("-", "−");
