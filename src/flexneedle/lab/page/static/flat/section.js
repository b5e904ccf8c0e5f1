// Draws a section: tissue, grid, reach, guide, target, and moving parts.

import { cutAlong } from "../planned.js";
import { isMeasured, shownOf, shownReach, shownRow } from "../shown.js";
import { regionOf, sensedPoints } from "../sensors.js";
import { shadeOf } from "../theme.js";
import { layersIn } from "./layers.js";
import { FOOT, SIDE, area, cross, disc, grid, inside, pointsOf, polyline, widthOf, words } from "./pen.js";
import { lateral, stretchIn } from "./plane.js";
import { reachIn } from "./reach.js";
import { drawNearest, drawZones } from "./zones.js";

const GUIDE = [6, 3.2]; // mm, length and width
const NAMES = { top: 24, step: 13, rows: 4, gap: 4 }; // px, of the names of layers; thin ones are below each other
const POINT = 2; // px, radius of a point of a sensor
const UP = { "x–y": "y (mm)", "x–z": "z (mm)", target: "from the axis (mm)" };

// The outline [[x, u], …] of the reach in a plane, none unless it is shown.
export function outlineOf(plane, store) {
  const news = shownReach(store);
  return (news && reachIn(plane, news, store.get("shape reach scene"))) ?? [];
}

// outline: of the reach. Returns whether it was drawn.
export function drawSection(pen, { width, height, map, plane, name, layers, guide, scene, target, others = [], parts, outline, zones = [], near = null, store }) {
  const place = (x, y, z) => [map.toX(x), map.toY(lateral(plane, x, y, z))];
  const row = shownRow(store);
  let reached = false;
  drawTissue(pen, map, layers, width, height);
  grid(pen, map, width, height, ["x (mm)", upward(name, map)]);
  inside(pen, width, height, () => {
    drawNames(pen, map, layers, width);
    reached = reach(pen, map, outline);
    if (zones.length) drawZones(pen, map, plane, zones, cutAlong(store, shownOf(store)), { silhouettes: scene.axes === 2 });
    for (const part of parts) draw(pen, part, place, map);
    if (near) drawNearest(pen, near, place);
    if (guide !== null) drawGuide(pen, map, plane, guide, scene, row);
    for (const point of sensedPoints(store)) disc(pen, place(...point), POINT, { tone: "--measured", alpha: 0.6 });
    drawRegion(pen, map, plane, row);
    if (isMeasured(row)) cross(pen, place(...row.measured), { tone: "--measured" });
    for (const { name, position } of others) drawOther(pen, map, plane, name, position);
    drawTarget(pen, map, plane, target);
  });
  return reached;
}

// The scene alone, before an insertion, small: layers without their names.
export function drawScene(pen, { width, height, map, plane, name, scene }) {
  drawTissue(pen, map, layersIn(scene), width, height);
  grid(pen, map, width, height, ["x (mm)", upward(name, map)]);
  inside(pen, width, height, () => {
    if (scene.guide) drawGuide(pen, map, plane, scene.guide[0], scene, null);
    drawTarget(pen, map, plane, scene.target);
  });
}

const upward = (name, map) => [UP[name], stretchIn(map)].filter(Boolean).join(", ");

// Its sphere of 1 mm, stretched as the lateral axis.
function drawTarget(pen, map, plane, [x, y, z]) {
  const radii = [map.sx, map.sy].map((scale) => Math.max(scale, 3));
  disc(pen, [map.toX(x), map.toY(lateral(plane, x, y, z))], radii, { tone: "--target", alpha: 0.85 });
}

// The 95 % region of the tip.
function drawRegion(pen, map, plane, row) {
  const [e, slope] = [plane.e, plane.slope];
  const corners = regionOf(row, [1, 0, 0], [-e[0] * slope[0] - e[1] * slope[1], ...e]);
  if (!corners.length) return;
  const [x, u] = [row.estimate[0], lateral(plane, ...row.estimate)];
  polyline(pen, corners.map(([right, up]) => [map.toX(x + right), map.toY(u + up)]), { tone: "--estimate", width: 1.25 });
}

// Another target, faint, with its name.
function drawOther(pen, map, plane, name, [x, y, z]) {
  const at = [map.toX(x), map.toY(lateral(plane, x, y, z))];
  disc(pen, at, [map.sx, map.sy].map((scale) => Math.max(scale, 3)), { tone: "--target", alpha: 0.3 });
  words(pen, name, [at[0], at[1] - Math.max(map.sy, 3) - 4], { tone: "--quiet" });
}

function drawTissue(pen, map, layers, width, height) {
  const bottom = height - FOOT;
  inside(pen, width, height, () => {
    for (const { top, bottom: end, modulus } of layers) {
      const [left, right] = edgesOf(map, top, end, width);
      area(pen, [[left, 0], [right, 0], [right, bottom], [left, bottom]], "--tissue", 0.12 + 0.3 * shadeOf(modulus));
      polyline(pen, [[left, 0], [left, bottom]], { tone: top === 0 ? "--skin" : "--tissue", width: top === 0 ? 2 : 1.25 });
    }
  });
}

// Names of the layers, each in the first row with room for it; without room a name is left out.
function drawNames(pen, map, layers, width) {
  const { top: first, step, rows, gap } = NAMES;
  const ends = Array(rows).fill(SIDE); // px, where the last name of each row ends
  for (const { name, top, bottom } of layers) {
    const [left, right] = edgesOf(map, top, bottom, width);
    const half = widthOf(pen, name) / 2;
    const at = Math.min((left + right) / 2, width - half - gap);
    const row = ends.findIndex((end) => end + gap <= at - half);
    if (left >= width || row < 0) continue;
    ends[row] = at + half;
    words(pen, name, [at, first + step * row], { tone: "--skin" });
  }
}

const edgesOf = (map, top, bottom, width) => [map.toX(top), bottom === null ? width : Math.min(map.toX(bottom), width)];

function reach(pen, map, outline) {
  if (!outline.length) return false;
  const points = outline.map(([x, u]) => [map.toX(x), map.toY(u)]);
  area(pen, points, "--reach", 0.2);
  polyline(pen, [...points, points[0]], { tone: "--reach", width: 1 });
  return true;
}

// One part of parts.js; the predicted needle with its band.
function draw(pen, { path, tone, width, thick, least = 1, alpha, dash, spread }, place, map) {
  const points = pointsOf(path, place);
  if (spread) {
    const sd = (at) => spread * path.values[at * path.columns + 3] * map.sy;
    const edge = (sign) => points.map(([x, y], at) => [x, y + sign * sd(at)]);
    area(pen, [...edge(-1), ...edge(1).reverse()], tone, 0.25);
  }
  polyline(pen, points, { tone, width: thick ? Math.max(thick * map.sy, least) : width, alpha, dash });
}

function drawGuide(pen, map, plane, x, scene, row) {
  const [, y, z] = scene.guide;
  const u = lateral(plane, x, ...(row?.guide ?? [y, z]));
  const [length, width] = GUIDE;
  for (const side of [-1, 1]) {
    const edge = [-1, 1].map((end) => [map.toX(x + (end * length) / 2), map.toY(u) + side * Math.max((width / 2) * map.sy, 5)]);
    polyline(pen, edge, { tone: "--guide", width: 3 });
  }
}
