// The reach: a shaded strip in its plane from the message, and the outlines at each depth from the frame.

import { BufferAttribute, BufferGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial } from "../vendor/three.js";
import { Lines } from "./lines.js";

export class Outlines {
  #lines = new Lines();

  constructor() {
    const material = new MeshBasicMaterial({ transparent: true, opacity: 0.18, depthWrite: false, side: DoubleSide });
    this.strip = new Mesh(new BufferGeometry(), material);
    this.strip.frustumCulled = false;
    this.strip.renderOrder = 1;
    this.group = new Group();
    this.group.add(this.strip, this.#lines.object);
  }

  // reach: its message, or null; strip: whether it is shown; shape: outlines, or null.
  update(reach, strip, shape, color) {
    this.group.visible = Boolean(reach);
    this.strip.visible = strip;
    if (!reach) return;
    this.strip.material.color = color;
    this.strip.geometry.dispose();
    this.strip.geometry = stripOf(reach);
    this.#lines.update(shape, color, () => 0.7);
  }
}

function stripOf({ low, high }) {
  const corners = low.flatMap((end, at) => [...end, ...high[at]]);
  const faces = low.slice(1).flatMap((_, at) => [2 * at, 2 * at + 1, 2 * at + 2, 2 * at + 1, 2 * at + 3, 2 * at + 2]);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(corners), 3));
  geometry.setIndex(faces);
  return geometry;
}
