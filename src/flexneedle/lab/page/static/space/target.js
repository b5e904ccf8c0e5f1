// The target: its sphere of 1 mm, and arrows that move it while nobody else is in control; the other targets, faint.

import { Group, Mesh, MeshLambertMaterial, SphereGeometry, TransformControls, Vector3 } from "../vendor/three.js";
import { mayMove, otherTargets, shownTarget, targetEdit } from "../shown.js";
import { paint } from "./room.js";

const RADIUS = 1; // mm
const FAINT = 0.25;
const SIZE = 0.7; // of the arrows
const COLORS = ["#0072b2", "#e69f00", "#cc79a7", "#f0e442"]; // of the arrows along x, y, z, and of the one held
const AXES = { X: [1, 0, 0], Y: [0, 1, 0], Z: [0, 0, 1] };
const OUT = ["Z", "YZ", "XZ"]; // that move it out of the plane
const HIDDEN = 1; // a layer that is neither drawn nor picked
const STEEP = Math.cos((20 * Math.PI) / 180); // an arrow nearer to the line of view covers the middle, which moves freely

export class Target {
  #store;
  #camera;
  #gizmo;
  #others = [];
  dragged = false;

  // camera: of camera.js; changed: called when it must be drawn again.
  constructor(camera, canvas, store, link, changed) {
    [this.#store, this.#camera] = [store, camera.camera];
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
    this.#gizmo.addEventListener("objectChange", () => {
      if (this.#isFlat) this.ball.position.z = shownTarget(store)[2];
      link.edit(targetEdit(store, this.ball.position.toArray()));
    });
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
  }

  get #isFlat() {
    return this.#store.get("scene")?.axes === 1;
  }

  // Neither draw nor pick arrows along the line of view (of the camera, or from it to the target) and out of a flat scene.
  hideArrows() {
    const views = [this.#camera.getWorldDirection(new Vector3()), this.ball.position.clone().sub(this.#camera.position).normalize()];
    const steep = Object.keys(AXES).filter((name) => views.some((view) => Math.abs(view.dot(new Vector3(...AXES[name]))) > STEEP));
    const hidden = this.#isFlat ? [...steep, ...OUT] : steep;
    this.#gizmo.getHelper().traverse((part) => part.layers.set(hidden.includes(part.name) ? HIDDEN : 0));
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
