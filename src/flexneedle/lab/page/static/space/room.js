// Fixed parts: layers of tissue, skin, mm grid with labels. y points upwards, z to the viewer.

import {
  BackSide, BoxGeometry, BufferAttribute, BufferGeometry, Color, DoubleSide, EdgesGeometry, Group, LineBasicMaterial,
  LineSegments, Mesh, MeshBasicMaterial, PlaneGeometry,
} from "../vendor/three.js";
import { shown } from "../dom.js";
import { color, shadeOf } from "../theme.js";

const STEP = 5; // mm
const ABOVE = 2.5; // mm, of the guide's label

export class Room {
  constructor(labels) {
    this.group = new Group();
    this.labels = labels;
  }

  // Draw the layers of a scene in a box.
  update(scene, box) {
    this.group.traverse((each) => {
      each.geometry?.dispose();
      each.material?.dispose();
    });
    this.group.clear();
    this.labels.clear();
    this.#addGrid(box);
    for (const layer of scene.layers) this.#addLayer(layer, box);
    this.guide = scene.guide && this.#label("guide", scene.guide, "--guide", [0.5, 0]);
  }

  // Put the guide's label above the guide.
  labelGuide({ x, y, z }) {
    this.guide?.position.set(x, y + ABOVE, z);
  }

  #addLayer({ name, top_mm: top, bottom_mm: bottom, shear_modulus_kpa: modulus }, { right, half }) {
    const end = Math.min(bottom ?? right, right);
    if (end <= top) return;
    const tissue = { color: color("--tissue"), transparent: true, depthWrite: false };
    const walls = new MeshBasicMaterial({ ...tissue, opacity: 0.1 + 0.3 * shadeOf(modulus), side: BackSide });
    const solid = new BoxGeometry(end - top, 2 * half, 2 * half);
    const layer = new Mesh(solid, walls);
    layer.position.x = (top + end) / 2;
    layer.name = "layer";
    layer.renderOrder = -2;
    this.group.add(layer);
    this.#addBoundary(top, half, top === 0 ? "--skin" : "--tissue");
    if (top === 0) this.#label("skin", [0, half, half], "--skin", [0.5, 0]);
    this.#label(name, [(top + end) / 2, half, -half], "--skin", [0.5, 0]);
  }

  #addBoundary(x, half, tone) {
    const paint = { color: color(tone), transparent: true, depthWrite: false };
    const plane = new Mesh(new PlaneGeometry(2 * half, 2 * half), new MeshBasicMaterial({ ...paint, opacity: 0.16, side: DoubleSide }));
    const edges = new LineSegments(new EdgesGeometry(plane.geometry), new LineBasicMaterial({ ...paint, opacity: 0.6 }));
    [plane.name, edges.name] = ["surface", "edge"];
    for (const each of [plane, edges]) {
      each.position.x = x;
      each.rotation.y = Math.PI / 2;
      each.renderOrder = -1;
      this.group.add(each);
    }
  }

  // Lines each 5 mm on floor and back wall, depths along the front, y and z at the left.
  #addGrid({ left, right, half }) {
    const points = [];
    for (let x = left; x <= right; x += STEP) points.push(x, -half, half, x, -half, -half, x, -half, -half, x, half, -half);
    for (let w = -half; w <= half; w += STEP) points.push(left, -half, w, right, -half, w, left, w, -half, right, w, -half);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(points), 3));
    const grid = new LineSegments(geometry, new LineBasicMaterial({ color: color("--grid"), transparent: true, opacity: 0.7 }));
    grid.name = "grid";
    grid.renderOrder = -3;
    this.group.add(grid);

    const every = right - left > 150 ? 50 : right - left > 60 ? 20 : 10;
    const out = half + 0.15 * half;
    const begin = every * Math.ceil((left + STEP) / every);
    for (let x = begin; x <= right; x += every) this.#label(shown(x, 0), [x, -half, out], "--quiet");
    this.#label("x (mm)", [right, -half, out], "--quiet", [0.5, 1.4]);
    for (const w of [-half, 0, half]) this.#label(shown(w, 0), [left, w, -half], "--quiet", [1.1, 0.5]);
    this.#label("y (mm)", [left, half, -half], "--quiet", [0.5, -0.3]);
    for (const w of [0, half]) this.#label(shown(w, 0), [left, -half, w], "--quiet", [1.1, 0.5]);
    this.#label("z (mm)", [left, -half, half], "--quiet", [0.8, 1.5]);
  }

  #label(text, point, tone, anchor) {
    return this.labels.add(text, point, color(tone), anchor);
  }
}

// Colour of style.css for three.js.
export const paint = (name) => new Color(color(name));
