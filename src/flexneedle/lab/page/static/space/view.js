// The view in space: draws the store's state, only when something has changed and it is on the screen.

import { AmbientLight, DirectionalLight, Scene, WebGLRenderer } from "../vendor/three.js";
import { boxOf } from "../box.js";
import { showLegend } from "../legend.js";
import { SHOWN, STEERING, otherTargets, shownOf, shownScene, shownTarget } from "../shown.js";
import { Camera } from "./camera.js";
import { Labels } from "./labels.js";
import { Room } from "./room.js";
import { Sensed } from "./sensed.js";
import { Shapes } from "./shapes.js";
import { Target } from "./target.js";
import { Zones } from "./zones.js";

const SHARPEST = 2; // device pixels to a pixel of the page

export class SpaceView {
  #store;
  #canvas;
  #legend;
  #frame = 0;
  #later = 0;
  #onScreen = true;
  #room = "";

  // context: WebGL's of a canvas in a stage; legend: a list.
  constructor(context, legend, store, link) {
    const { canvas } = context;
    [this.#canvas, this.#legend, this.#store] = [canvas, legend, store];
    this.renderer = new WebGLRenderer({ canvas, context });
    this.camera = new Camera(canvas, () => this.#schedule());
    this.labels = new Labels();
    this.room = new Room(this.labels);
    this.shapes = new Shapes();
    this.sensed = new Sensed();
    this.zones = new Zones();
    this.renderer.localClippingEnabled = true; // of zones, at the room
    this.target = new Target(this.camera, canvas, store, link, () => this.#schedule());
    this.scene = new Scene();
    this.scene.add(this.room.group, this.labels.group, this.shapes.group, this.sensed.group, this.zones.group, this.target.group, ...lights(this.camera.camera));
    new ResizeObserver(([{ contentRect }]) => this.#resize(contentRect)).observe(canvas.parentElement);
    new IntersectionObserver((entries) => this.#appear(entries.at(-1).isIntersecting)).observe(canvas);
    store.subscribe([...SHOWN, ...STEERING], () => this.#update());
  }

  // Draw the scene and return its canvas. Read it before returning to the browser, which clears it.
  drawn() {
    this.renderer.render(this.scene, this.camera.camera);
    return this.#canvas;
  }

  #update() {
    const scene = shownScene(this.#store);
    if (!scene) return;
    this.#updateRoom(scene);
    const entries = [...this.shapes.update(this.#store, scene, shownOf(this.#store)), ...this.sensed.update(this.#store), ...this.zones.update(this.#store)];
    this.room.labelGuide(this.shapes.guide.position);
    showLegend(this.#legend, entries, otherTargets(this.#store));
    this.target.update();
    this.#later ||= requestAnimationFrame(() => {
      this.#later = 0;
      this.#schedule();
    }); // one frame after the flat views, to spread the work
  }

  #updateRoom(scene) {
    const box = boxOf(scene, shownTarget(this.#store), otherTargets(this.#store));
    const room = JSON.stringify([box, scene.layers, scene.guide, this.#store.get("view theme")]);
    if (room === this.#room) return;
    const another = JSON.stringify(box) !== JSON.stringify(JSON.parse(this.#room || "[null]")[0]);
    this.#room = room;
    this.room.update(scene, box);
    this.zones.clip(box);
    this.#fitLabels();
    if (another && !this.target.dragged) this.camera.follow(box);
  }

  #resize({ width, height }) {
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, SHARPEST));
    this.renderer.setSize(width, height, false);
    this.height = height;
    this.#fitLabels();
    this.camera.resize(width, height);
    this.#schedule();
  }

  #fitLabels() {
    this.labels.fit(this.height ?? 300, this.camera.camera.fov);
  }

  #appear(onScreen) {
    this.#onScreen = onScreen;
    if (onScreen) this.#schedule();
  }

  #schedule() {
    if (!this.#onScreen) return;
    this.#frame ||= requestAnimationFrame(() => this.#render());
  }

  #render() {
    cancelAnimationFrame(this.#frame);
    this.#frame = 0;
    this.target.hideArrows();
    this.renderer.render(this.scene, this.camera.camera);
  }
}

// Ambient light, and light from above the viewer's left shoulder.
function lights(camera) {
  const sun = new DirectionalLight("#ffffff", 2.2);
  sun.position.set(-0.5, 1, 0.6);
  camera.add(sun, sun.target);
  return [new AmbientLight("#ffffff", 1.4), camera];
}
