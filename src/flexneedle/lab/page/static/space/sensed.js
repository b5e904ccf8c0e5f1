// Sensors along the needle: points that they measured, and the region of the tip.

import { Group, Mesh, MeshBasicMaterial, SphereGeometry } from "../vendor/three.js";
import { pointEntries, regionEntries, sensedPoints } from "../sensors.js";
import { shownRow } from "../shown.js";
import { paint } from "./room.js";

const POINT = 0.3; // mm, radius
const RADIUS = 2.7955; // of the 95 % region in space, in standard deviations: root of χ² with three degrees of freedom

export class Sensed {
  #points = new Group();
  #dot = new SphereGeometry(POINT, 8, 6);
  #paint = new MeshBasicMaterial({ transparent: true, opacity: 0.7 });
  #region = new Mesh(new SphereGeometry(RADIUS, 24, 16), new MeshBasicMaterial({ transparent: true, opacity: 0.35, depthWrite: false }));

  constructor() {
    this.group = new Group();
    this.group.add(this.#points, this.#region);
    [this.#points.name, this.#region.name] = ["sensed", "tip region"];
    this.#region.matrixAutoUpdate = false;
    this.#region.renderOrder = 6;
  }

  // Draw the state of the store. Return entries of the legend.
  update(store) {
    const points = sensedPoints(store);
    this.#paint.color = paint("--measured");
    while (this.#points.children.length < points.length) this.#points.add(new Mesh(this.#dot, this.#paint));
    this.#points.children.forEach((dot, at) => {
      dot.visible = at < points.length;
      if (dot.visible) dot.position.set(...points[at]);
    });
    this.#placeRegion(shownRow(store));
    return [...pointEntries(store), ...regionEntries(store)];
  }

  // A sphere becomes the ellipsoid by the root of the covariance.
  #placeRegion(row) {
    this.#region.visible = Boolean(row?.tip_covariance);
    if (!this.#region.visible) return;
    this.#region.material.color = paint("--estimate");
    const [[a, b, c], [d, e, f], [g, h, i]] = rootOf(row.tip_covariance);
    const [x, y, z] = row.estimate;
    this.#region.matrix.set(a, b, c, x, d, e, f, y, g, h, i, z, 0, 0, 0, 1);
    this.#region.matrixWorldNeedsUpdate = true;
  }
}

// The lower triangular root L of a covariance C = L Lᵀ; a direction without variance has zeros.
export function rootOf(matrix) {
  const root = matrix.map((row) => row.map(() => 0));
  for (let i = 0; i < matrix.length; i++) {
    for (let j = 0; j <= i; j++) {
      const rest = matrix[i][j] - root[i].reduce((sum, part, k) => (k < j ? sum + part * root[j][k] : sum), 0);
      root[i][j] = i === j ? Math.sqrt(Math.max(0, rest)) : root[j][j] && rest / root[j][j];
    }
  }
  return root;
}
