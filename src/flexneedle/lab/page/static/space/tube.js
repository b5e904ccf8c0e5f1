// A tube along points, whose buffers are used again at each update.

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Mesh } from "../vendor/three.js";

export class Tube {
  #sides;
  #room = 0; // points that the buffers hold

  // material: of three.js; sides: corners of a cross-section.
  constructor(material, sides = 10) {
    this.#sides = sides;
    this.mesh = new Mesh(new BufferGeometry(), material);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  // Show a path {values, points, columns}, or nothing (null). radius: mm, or a function of the point's index;
  // color: a function of index and place (r, g, b from `at` on), where the material has vertex colours.
  update(path, radius, color = null) {
    this.mesh.visible = Boolean(path) && path.points > 1;
    if (!this.mesh.visible) return;
    this.#reserve(path.points, color !== null);
    const radiusOf = typeof radius === "function" ? radius : () => radius;
    const geometry = this.mesh.geometry;
    sweep(path, radiusOf, this.#sides, geometry.attributes.position.array, geometry.attributes.normal.array);
    geometry.attributes.position.needsUpdate = geometry.attributes.normal.needsUpdate = true;
    if (color) this.#paint(path.points, color);
    geometry.setDrawRange(0, 6 * this.#sides * (path.points + 1));
  }

  #paint(points, color) {
    const attribute = this.mesh.geometry.attributes.color;
    for (let ring = 0; ring < points + 2; ring++) {
      const point = Math.min(Math.max(ring - 1, 0), points - 1);
      for (let side = 0; side < this.#sides; side++) color(point, attribute.array, 3 * (ring * this.#sides + side));
    }
    attribute.needsUpdate = true;
  }

  #reserve(points, colored) {
    if (points <= this.#room) return;
    this.#room = Math.ceil(1.5 * points);
    const rings = this.#room + 2; // a ring of radius 0 closes each end
    const geometry = this.mesh.geometry;
    geometry.dispose();
    for (const name of ["position", "normal", ...(colored ? ["color"] : [])]) {
      const attribute = new BufferAttribute(new Float32Array(3 * rings * this.#sides), 3);
      geometry.setAttribute(name, attribute.setUsage(DynamicDrawUsage));
    }
    geometry.setIndex(new BufferAttribute(facesOf(rings, this.#sides), 1));
  }
}

function facesOf(rings, sides) {
  const faces = new Uint32Array(6 * sides * (rings - 1));
  let at = 0;
  for (let ring = 0; ring < rings - 1; ring++) {
    for (let side = 0; side < sides; side++) {
      const [a, b] = [ring * sides + side, ring * sides + ((side + 1) % sides)];
      faces.set([a, b, a + sides, b, b + sides, a + sides], at);
      at += 6;
    }
  }
  return faces;
}

// Rings around the points, each across the path's direction there, without twist: the first normal is carried along.
function sweep({ values, points, columns }, radiusOf, sides, position, normal) {
  let n = [0, 1, 0];
  for (let ring = 0; ring < points + 2; ring++) {
    const point = Math.min(Math.max(ring - 1, 0), points - 1);
    const closed = ring === 0 || ring === points + 1;
    const t = direction(values, point, points, columns);
    n = unit(without(n, t));
    const b = cross(t, n);
    const radius = closed ? 0 : radiusOf(point);
    for (let side = 0; side < sides; side++) {
      const angle = (2 * Math.PI * side) / sides;
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      const at = 3 * (ring * sides + side);
      for (let axis = 0; axis < 3; axis++) {
        const outward = c * n[axis] + s * b[axis];
        position[at + axis] = values[point * columns + axis] + radius * outward;
        normal[at + axis] = closed ? (ring ? t[axis] : -t[axis]) : outward;
      }
    }
  }
}

function direction(values, point, points, columns) {
  const [before, after] = [Math.max(point - 1, 0) * columns, Math.min(point + 1, points - 1) * columns];
  const along = [0, 1, 2].map((axis) => values[after + axis] - values[before + axis]);
  return along.some((value) => value !== 0) ? unit(along) : [1, 0, 0];
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// `a` without its part along the unit vector `t`; another where they are parallel.
function without(a, t) {
  const along = dot(a, t);
  const rest = a.map((value, axis) => value - along * t[axis]);
  return dot(rest, rest) > 1e-6 ? rest : without([t[1], t[2], t[0] + 0.5], t);
}

function unit(a) {
  const length = Math.hypot(...a);
  return a.map((value) => value / length);
}
