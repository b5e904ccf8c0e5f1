// The camera: fits the box, turns, zooms and shifts by pointer, keys and buttons.

import { OrbitControls, PerspectiveCamera, Vector3 } from "../vendor/three.js";

const TURN = Math.PI / 36;
const SHIFT = 0.05; // of the distance
const LABELS = [36, 24]; // pixels at each side, above and below
const DIRECTIONS = { side: [0, 0, 1], top: [0, 1, 0.0001], axis: [-1, 0, 0.0001] };
const [WIDE, NARROW] = [[-0.28, 0.42, 1], [-0.9, 0.55, 1]];
const KEYS = { "+": ["zoom", 0.8], "=": ["zoom", 0.8], "-": ["zoom", 1.25], 0: ["look", "reset"], Home: ["look", "reset"],
  1: ["look", "side"], 2: ["look", "top"], 3: ["look", "axis"] };
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export class Camera {
  #changed;
  #box = null;
  #free = [1, 1]; // share of width and height without labels
  #moved = false;

  // canvas: whose pointer and keys it follows; changed: called after each movement.
  constructor(canvas, changed) {
    this.#changed = changed;
    this.camera = new PerspectiveCamera(36, 1, 1, 5000);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", changed);
    this.controls.addEventListener("start", () => {
      this.#moved = true;
    });
    canvas.addEventListener("keydown", (event) => this.#press(event));
  }

  // The view has another size.
  resize(width, height) {
    this.#free = [Math.max(0.3, 1 - (2 * LABELS[0]) / width), Math.max(0.3, 1 - (2 * LABELS[1]) / height)];
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.#refit();
  }

  // The box has changed; the view follows until the user moves it.
  follow(box) {
    this.#box = box;
    this.#refit();
  }

  // Show a side: reset, side (x–y), top (x–z) or axis.
  look(name) {
    this.#moved = name !== "reset";
    this.#fit(DIRECTIONS[name] ?? (this.camera.aspect > 1.5 ? WIDE : NARROW));
    this.#changed();
  }

  // Change the distance by a factor.
  zoom(factor) {
    this.#move((offset) => offset.multiplyScalar(factor));
  }

  #refit() {
    if (this.#box && !this.#moved) this.look("reset");
  }

  // Place the camera so that all corners of the box are in view.
  #fit(direction) {
    const { left, right, half } = this.#box;
    const [camera, middle] = [this.camera, new Vector3((left + right) / 2, 0, 0)];
    camera.position.copy(middle).add(new Vector3(...direction));
    camera.lookAt(middle);
    const axes = [new Vector3(), new Vector3(), new Vector3()];
    camera.matrix.compose(camera.position, camera.quaternion, camera.scale);
    camera.matrix.extractBasis(...axes);
    const up = Math.tan((camera.fov * Math.PI) / 360);
    const distances = cornersOf((right - left) / 2, half).map((corner) => {
      const [x, y, z] = axes.map((axis) => axis.dot(corner));
      return z + Math.max(Math.abs(x) / (up * camera.aspect * this.#free[0]), Math.abs(y) / (up * this.#free[1]));
    });
    camera.position.copy(middle).addScaledVector(axes[2], Math.max(...distances));
    this.controls.target.copy(middle);
    this.controls.update();
  }

  #press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const [action, argument] = KEYS[event.key] ?? [];
    const arrow = ARROWS[event.key];
    if (action) this[action](argument);
    else if (arrow && event.shiftKey) this.#shift(...arrow);
    else if (arrow) this.#turn(...arrow);
    else return;
    event.preventDefault();
  }

  #turn(sideways, upwards) {
    this.#move((offset) => {
      const polar = Math.acos(offset.y / offset.length());
      const turned = Math.min(Math.max(polar - upwards * TURN, 0.01), Math.PI - 0.01);
      const right = new Vector3(0, 1, 0).cross(offset).normalize();
      offset.applyAxisAngle(right, turned - polar).applyAxisAngle(this.camera.up, sideways * TURN);
    });
  }

  #shift(sideways, upwards) {
    const right = new Vector3().setFromMatrixColumn(this.camera.matrix, 0);
    const up = new Vector3().setFromMatrixColumn(this.camera.matrix, 1);
    const step = SHIFT * this.camera.position.distanceTo(this.controls.target);
    const by = right.multiplyScalar(sideways * step).addScaledVector(up, upwards * step);
    this.controls.target.add(by);
    this.camera.position.add(by);
    this.#move(() => {});
  }

  #move(change) {
    this.#moved = true;
    const offset = this.camera.position.clone().sub(this.controls.target);
    change(offset);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.#changed();
  }
}

// Corners of a box from its middle.
function cornersOf(along, across) {
  const ends = [-1, 1];
  return ends.flatMap((x) => ends.flatMap((y) => ends.map((z) => new Vector3(x * along, y * across, z * across))));
}
