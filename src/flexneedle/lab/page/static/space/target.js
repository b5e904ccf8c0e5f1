// The target: its sphere of 1 mm, and arrows that move it while nobody else is in control.

import { Group, Mesh, MeshLambertMaterial, SphereGeometry, TransformControls } from "../vendor/three.js";
import { mayMove, shownTarget, targetEdit } from "../shown.js";
import { paint } from "./room.js";

const RADIUS = 1; // mm
const SIZE = 0.7; // of the arrows
const COLORS = ["#0072b2", "#e69f00", "#cc79a7", "#f0e442"]; // of the arrows along x, y, z, and of the one held

export class Target {
  #store;
  #gizmo;
  dragged = false;

  // camera: of camera.js; changed: called when it must be drawn again.
  constructor(camera, canvas, store, link, changed) {
    this.#store = store;
    this.ball = new Mesh(new SphereGeometry(RADIUS, 32, 16), new MeshLambertMaterial({ transparent: true, opacity: 0.75 }));
    this.ball.name = "target";
    this.ball.renderOrder = 7;
    this.#gizmo = new TransformControls(camera.camera, canvas);
    this.#gizmo.setSize(SIZE);
    this.#gizmo.setColors(...COLORS);
    this.#gizmo.attach(this.ball);
    this.#gizmo.addEventListener("change", changed);
    this.#gizmo.addEventListener("dragging-changed", ({ value }) => {
      this.dragged = value;
      camera.controls.enabled = !value;
      if (value) return;
      this.update();
      link.rest();
    });
    this.#gizmo.addEventListener("objectChange", () => link.edit(targetEdit(store, this.ball.position.toArray())));
    this.group = new Group();
    this.group.add(this.ball, this.#gizmo.getHelper());
  }

  update() {
    const target = shownTarget(this.#store);
    this.group.visible = Boolean(target);
    if (target && !this.dragged) this.ball.position.set(...target);
    this.ball.material.color = paint("--target");
    this.#gizmo.enabled = this.#gizmo.getHelper().visible = mayMove(this.#store);
    this.#gizmo.showZ = this.#store.get("scene")?.axes === 2;
  }
}
