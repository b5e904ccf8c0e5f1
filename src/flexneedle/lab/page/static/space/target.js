// The target: its sphere of 1 mm, and arrows that move it while nobody else is in control; the other targets, faint.

import { Group, Mesh, MeshLambertMaterial, SphereGeometry, TransformControls } from "../vendor/three.js";
import { mayMove, otherTargets, shownTarget, targetEdit } from "../shown.js";
import { paint } from "./room.js";

const RADIUS = 1; // mm
const FAINT = 0.25;
const SIZE = 0.7; // of the arrows
const COLORS = ["#0072b2", "#e69f00", "#cc79a7", "#f0e442"]; // of the arrows along x, y, z, and of the one held

export class Target {
  #store;
  #gizmo;
  #others = [];
  dragged = false;

  // camera: of camera.js; changed: called when it must be drawn again.
  constructor(camera, canvas, store, link, changed) {
    this.#store = store;
    this.ball = ballOf("target", 0.75);
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
    this.#showOthers();
    this.#gizmo.enabled = this.#gizmo.getHelper().visible = mayMove(this.#store);
    this.#gizmo.showZ = this.#store.get("scene")?.axes === 2;
  }

  #showOthers() {
    const others = otherTargets(this.#store);
    while (this.#others.length < others.length) this.#others.push(ballOf("other target", FAINT));
    this.#others.forEach((ball, at) => {
      if (others[at]) this.group.add(ball);
      else ball.removeFromParent();
      if (others[at]) ball.position.set(...others[at].position);
      ball.material.color = paint("--target");
    });
  }
}

function ballOf(name, opacity) {
  const ball = new Mesh(new SphereGeometry(RADIUS, 32, 16), new MeshLambertMaterial({ transparent: true, opacity }));
  return Object.assign(ball, { name, renderOrder: 7 });
}
