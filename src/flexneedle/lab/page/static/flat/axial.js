// Draws the view along the axis: reach at the target's depth, paths, tips, guide, bevel, target.

import { tipOf } from "../paths.js";
import { rollOf } from "../planned.js";
import { isMeasured, shownOf, shownReach, shownRow } from "../shown.js";
import { regionOf } from "../sensors.js";
import { area, cross, disc, grid, inside, pointsOf, polyline } from "./pen.js";
import { reachAt } from "./reach.js";

const READINGS = 40; // measured positions, as crosses; other points are discs
const NARROW = 120; // px, without room for the unit
const BEVEL = 26; // px, length of the arrow

// Ends of the reach at the target's depth [[x, y, z], …], none unless it is shown.
export function endsOf(store, target) {
  const outlines = store.get("shape reach scene");
  return shownReach(store) && outlines ? reachAt(target[0], outlines) : [];
}

// ends: of the reach. Returns whether it was drawn.
export function drawAxial(pen, { width, height, map, scene, target, others, parts, ends, store }) {
  const place = (_x, y, z) => [map.toX(z), map.toY(y)];
  const [of, row] = [shownOf(store), shownRow(store)];
  grid(pen, map, width, height, width < NARROW ? ["z", "y"] : ["z (mm)", "y (mm)"]);
  let reached = false;
  inside(pen, width, height, () => {
    reached = reach(pen, place, ends);
    for (const { position } of others) disc(pen, place(...position), Math.max(map.sx, 3), { tone: "--target", alpha: 0.2 });
    disc(pen, place(...target), Math.max(map.sx, 3), { tone: "--target", alpha: 0.5 });
    for (const part of parts) draw(pen, part, place, map);
    if (row) readings(pen, place, store.get(`rows ${of}`).slice(Math.max(0, row.index - READINGS), row.index + 1));
    region(pen, map, row);
    if (scene.guide) guide(pen, place(0, ...(row?.guide ?? scene.guide.slice(1))));
    const needle = parts.find(({ text }) => text === "needle");
    if (needle) bevel(pen, place(...tipOf(needle.path)), rollOf(store, of));
  });
  return reached;
}

// Needles are shown by their tips, sampled and predicted paths by their ends.
function draw(pen, { path, tone, width = 1, alpha = 1, dash, thick, sampled, predicted, spread }, place, map) {
  const end = place(...tipOf(path));
  if (sampled) disc(pen, end, 2, { tone, alpha: Math.min(1, 1.6 * alpha) });
  else if (predicted) {
    const sd = spread ? path.values[(path.points - 1) * path.columns + 3] : 0;
    if (spread) disc(pen, end, Math.max(spread * sd * map.sx, 2), { tone, alpha: 0.3 });
    disc(pen, end, 3, { tone, open: true });
  } else if (thick) disc(pen, end, Math.max((thick / 2) * map.sx, 3), { tone });
  else polyline(pen, pointsOf(path, place), { tone, width, alpha, dash });
}

function reach(pen, place, ends) {
  if (ends.length < 2) return false;
  const corners = ends.map((end) => place(...end));
  area(pen, corners, "--reach", 0.2);
  polyline(pen, [...corners, corners[0]], { tone: "--reach" });
  return true;
}

function readings(pen, place, rows) {
  for (const each of rows) {
    if (isMeasured(each)) cross(pen, place(...each.measured), { tone: "--measured" });
  }
}

// The 95 % region of the tip.
function region(pen, map, row) {
  const corners = regionOf(row, [0, 0, 1], [0, 1, 0]);
  if (corners.length) polyline(pen, corners.map(([z, y]) => [map.toX(row.estimate[2] + z), map.toY(row.estimate[1] + y)]), { tone: "--estimate", width: 1.25 });
}

function guide(pen, [x, y]) {
  polyline(pen, [[x - 6, y - 6], [x + 6, y - 6], [x + 6, y + 6], [x - 6, y + 6], [x - 6, y - 6]], { tone: "--guide", width: 2 });
}

function bevel(pen, [x, y], roll) {
  const angle = (roll * Math.PI) / 180; // from y to z
  const toward = [Math.sin(angle), -Math.cos(angle)];
  const [tx, ty] = [x + BEVEL * toward[0], y + BEVEL * toward[1]];
  polyline(pen, [[x, y], [tx, ty]], { tone: "--ink", width: 1.75 });
  const side = (sign) => [tx - 6 * toward[0] + sign * 3 * toward[1], ty - 6 * toward[1] - sign * 3 * toward[0]];
  area(pen, [[tx, ty], side(1), side(-1)], "--ink", 1);
}
