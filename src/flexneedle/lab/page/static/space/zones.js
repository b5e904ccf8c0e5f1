// Zones to avoid in space: translucent surfaces, their margins, and a line at the least clearance.

import { BufferAttribute, BufferGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial, MeshLambertMaterial, Vector3 } from "../vendor/three.js";
import { shownNearest, shownZones, zoneEntries } from "../zones.js";
import { paint } from "./room.js";
import { Tube } from "./tube.js";

const ROOM = 0.05; // mm, around the box: a zone may end with it
const LINE = 0.1; // mm, radius of the line

export class Zones {
  #meshes = []; // [zone, margin] by number of the zone
  #clip = [];
  #line = new Tube(new MeshBasicMaterial({ depthTest: false, transparent: true }));

  constructor() {
    this.group = new Group();
    this.#line.mesh.name = "clearance";
    this.#line.mesh.renderOrder = 9;
    this.group.add(this.#line.mesh);
  }

  // Show only what is in a box.
  clip({ left, right, half }) {
    const within = (x, y, z, constant) => ({ normal: new Vector3(x, y, z), constant: constant + ROOM });
    this.#clip = [
      within(1, 0, 0, -left), within(-1, 0, 0, right), within(0, 1, 0, half), within(0, -1, 0, half), within(0, 0, 1, half), within(0, 0, -1, half),
    ];
  }

  // Draw the state of the store. Return entries of the legend.
  update(store) {
    const [zones, near] = [shownZones(store), shownNearest(store)];
    while (this.#meshes.length > zones.length) this.#drop(this.#meshes.pop());
    zones.forEach((zone, number) => this.#show(number, zone));
    const ends = near && Float32Array.from([...near.needle, ...near.surface]);
    this.#line.update(ends && { points: 2, columns: 3, values: ends }, LINE);
    this.#line.mesh.material.color = paint("--ink");
    return zoneEntries(zones, near);
  }

  #show(number, { surface, margin, offset }) {
    this.#meshes[number] ??= this.#make();
    for (const [mesh, shape] of [[this.#meshes[number][0], surface], [this.#meshes[number][1], margin]]) {
      if (mesh.userData.shape !== shape) fit(mesh, shape);
      mesh.position.set(...offset);
      mesh.material.color = paint("--zone");
      mesh.material.clippingPlanes = this.#clip;
    }
  }

  #make() {
    const zone = new Mesh(new BufferGeometry(), new MeshLambertMaterial({ transparent: true, opacity: 0.55, side: DoubleSide, depthWrite: false }));
    const margin = new Mesh(new BufferGeometry(), new MeshBasicMaterial({ transparent: true, opacity: 0.1, depthWrite: false }));
    [zone.name, margin.name, zone.renderOrder, margin.renderOrder] = ["zone", "margin", 1, 1.5];
    this.group.add(zone, margin);
    return [zone, margin];
  }

  #drop(meshes) {
    for (const mesh of meshes) {
      mesh.geometry.dispose();
      mesh.material.dispose();
    }
    this.group.remove(...meshes);
  }
}

function fit(mesh, shape) {
  mesh.geometry.dispose();
  mesh.geometry = new BufferGeometry();
  mesh.geometry.setAttribute("position", new BufferAttribute(Float32Array.from(shape.points), 3));
  mesh.geometry.setIndex(new BufferAttribute(Uint32Array.from(shape.triangles), 1));
  mesh.geometry.computeVertexNormals();
  mesh.visible = shape.triangles.length > 0;
  mesh.userData.shape = shape;
}
