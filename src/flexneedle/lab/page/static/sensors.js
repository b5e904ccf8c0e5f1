// Sensors along the needle: their points, and the region of the tip.

import { shownOf, shownRow } from "./shown.js";

const NEWEST = 10; // periods whose points are shown
const RADIUS = Math.sqrt(-2 * Math.log(0.05)); // of the 95 % region in a plane, in standard deviations
const CORNERS = 48;

// Points [x, y, z] (mm) that sensors measured in the shown period and the ones before it.
export function sensedPoints(store) {
  const row = shownRow(store);
  const rows = row ? store.get(`rows ${shownOf(store)}`).slice(Math.max(0, row.index + 1 - NEWEST), row.index + 1) : [];
  return rows.flatMap(({ sensors = [] }) => sensors.flatMap(({ points }) => points));
}

// The 95 % region of the tip of a row as corners [across, up] (mm) from the tip, along two directions in space; none if
// it is unknown.
export function regionOf(row, across, up) {
  const matrix = row?.tip_covariance;
  if (!matrix) return [];
  const times = (a, b) => a.reduce((sum, part, i) => sum + part * b.reduce((rest, other, j) => rest + matrix[i][j] * other, 0), 0);
  const first = Math.sqrt(times(across, across));
  const mixed = first ? times(across, up) / first : 0;
  const rest = Math.sqrt(Math.max(0, times(up, up) - mixed * mixed));
  return Array.from({ length: CORNERS + 1 }, (_, at) => {
    const [cos, sin] = [Math.cos, Math.sin].map((of) => RADIUS * of((2 * Math.PI * at) / CORNERS));
    return [first * cos, mixed * cos + rest * sin];
  });
}

// Entries of the legend for both.
export const pointEntries = (store) => (sensedPoints(store).length ? [{ text: "points of sensors", tone: "--measured", form: "disc" }] : []);
export const regionEntries = (store) => (shownRow(store)?.tip_covariance ? [{ text: "tip, 95 % region", tone: "--estimate" }] : []);
