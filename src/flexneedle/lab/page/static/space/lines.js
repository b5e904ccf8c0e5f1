// Many paths as thin lines in one object, whose buffers are used again at each update.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, LineBasicMaterial, LineSegments } from "../vendor/three.js";

export class Lines {
  #room = 0; // corners that the buffers hold

  constructor() {
    const material = new LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false });
    this.object = new LineSegments(new BufferGeometry(), material);
    this.object.frustumCulled = false;
    this.object.visible = false;
  }

  // Show the paths of a shape {values, paths, points, columns}, or nothing (null). color: Color of three.js;
  // opacityOf: of a path by its index.
  update(shape, color, opacityOf) {
    this.object.visible = Boolean(shape) && shape.paths > 0 && shape.points > 1;
    if (!this.object.visible) return;
    const corners = 2 * shape.paths * (shape.points - 1);
    this.#reserve(corners);
    const { position, color: paint } = this.object.geometry.attributes;
    fill(shape, color, opacityOf, position.array, paint.array);
    position.needsUpdate = paint.needsUpdate = true;
    this.object.geometry.setDrawRange(0, corners);
  }

  #reserve(corners) {
    if (corners <= this.#room) return;
    this.#room = Math.ceil(1.5 * corners);
    const geometry = this.object.geometry;
    geometry.dispose();
    for (const [name, size] of [["position", 3], ["color", 4]]) {
      const attribute = new BufferAttribute(new Float32Array(size * this.#room), size);
      geometry.setAttribute(name, attribute.setUsage(DynamicDrawUsage));
    }
  }
}

function fill({ values, paths, points, columns }, color, opacityOf, position, paint) {
  let corner = 0;
  for (let path = 0; path < paths; path++) {
    const opacity = opacityOf(path);
    for (let point = 0; point < points - 1; point++) {
      for (let end = 0; end < 2; end++, corner++) {
        const at = (path * points + point + end) * columns;
        for (let axis = 0; axis < 3; axis++) position[3 * corner + axis] = values[at + axis];
        paint[4 * corner] = color.r;
        paint[4 * corner + 1] = color.g;
        paint[4 * corner + 2] = color.b;
        paint[4 * corner + 3] = opacity;
      }
    }
  }
}
