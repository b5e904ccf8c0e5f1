// Zones to avoid of the shown state, the least clearance from them, and the edits that move a zone or the entry.

import { isStale, shownOf, shownRow } from "./shown.js";

const ENTRY = ["entry.lateral_mm", "entry.lateral_z_mm"];

// Zones [{name, surface, margin, offset, center}]: offset (mm): how far a zone has been moved since its surface was computed;
// center: its middle, or null for a zone that cannot be moved.
export function shownZones(store) {
  const of = shownOf(store);
  return (store.get(`zones ${of}`)?.zones ?? []).map((zone, number) => {
    const now = of === "scene" ? placesNow(store, number) ?? zone.places : zone.places;
    const keys = Object.keys(zone.places);
    const middle = (places) => [0, 1, 2].map((axis) => keys.reduce((sum, key) => sum + (places[key] ?? zone.places[key])[axis], 0) / keys.length);
    const [before, center] = keys.length ? [middle(zone.places), middle(now)] : [[0, 0, 0], null];
    return { ...zone, number, center, offset: center ? center.map((part, axis) => part - before[axis]) : before };
  });
}

// The edit that moves the middle of a zone of the scene to a point (x, y, z).
export function zoneEdit(store, number, point) {
  const { center } = shownZones(store)[number];
  const moved = (place) => place.map((part, axis) => rounded(part + point[axis] - center[axis]));
  return Object.fromEntries(Object.entries(placesNow(store, number)).map(([key, place]) => [key, moved(place)]));
}

// The entry of the scene (x, y, z), with a pending edit.
export function entryOf(store) {
  const draft = store.get("draft") ?? {};
  return [0, ...store.get("scene").axis.point.map((value, axis) => draft[ENTRY[axis]] ?? value)];
}

// The edit that moves the entry to a point; in the plane without z.
export function entryEdit(store, point) {
  const keys = ENTRY.slice(0, store.get("scene").axes);
  return Object.fromEntries(keys.map((key, axis) => [key, rounded(point[axis + 1])]));
}

// The least clearance {zone, clearance_mm, needle, surface}: of the plan, or of the estimated needle at the shown period; or null.
export function shownNearest(store) {
  const of = shownOf(store);
  if (of !== "scene") return shownRow(store, of)?.nearest ?? null;
  const plan = store.get(`plan ${store.get("session")?.strategy}`);
  return isStale(store, plan) ? null : plan?.nearest ?? null;
}

// Entries of the legend. silhouettes: whether they are drawn.
export function zoneEntries(zones, near, silhouettes = false) {
  const shown = zones.some(({ surface }) => surface.triangles.length);
  return [
    ...(shown ? [{ text: "zone to avoid", tone: "--zone", form: "area" }, { text: "its margin, for the needle's axis", tone: "--zone", form: "dashed" }] : []),
    ...(shown && silhouettes ? [{ text: "zone, silhouette", tone: "--zone", form: "area", faint: true }] : []),
    ...(near ? [{ text: `least clearance ${clearanceIn(near)} to ${near.zone}`, tone: "--ink", form: "line" }] : []),
  ];
}

export const clearanceIn = ({ clearance_mm: clearance }) => `${clearance.toFixed(2).replace("-", "−")} mm`;

// Positions of a zone of the scene by key, with pending edits; undefined for one that it does not have.
function placesNow(store, number) {
  const places = store.get("scene")?.zones?.[number];
  const draft = store.get("draft") ?? {};
  return places && Object.fromEntries(Object.entries(places).map(([key, place]) => [key, draft[key] ?? place]));
}

const rounded = (value) => Math.round(100 * value) / 100;
