// A plan as in the paper's figure: the needle at some of its steps, from light to strong, in the plane of axis and target.

import { boxOf } from "../box.js";
import { make } from "../dom.js";
import { drawScene } from "../flat/section.js";
import { inside, pointsOf, polyline } from "../flat/pen.js";
import { lateral, mappingOf, planeOf, stretchIn } from "../flat/plane.js";
import { Stage } from "../flat/stage.js";
import { pathAt } from "../paths.js";
import { isStale } from "../shown.js";

const NEEDLES = 9;
const FAINT = 0.15;
const STRETCH = 3; // of the lateral axis

export class SweepView {
  #store;
  #strategy;
  #stage;
  #caption;
  #drawn = [];

  constructor(parent, store, strategy) {
    [this.#store, this.#strategy] = [store, strategy];
    const canvas = make("canvas", { role: "img", "aria-label": `Needle by ${strategy}, at steps of the plan` });
    this.#caption = make("figcaption", {}, strategy);
    this.figure = make("figure", { hidden: true }, this.#caption, make("div.stage", {}, canvas));
    parent.append(this.figure);
    this.#stage = new Stage(canvas, (pen, { width, height }) => this.#draw(pen, width, height));
  }

  update() {
    const used = [this.#plan, this.#sweep, this.#store.get("scene"), this.#store.get("view theme")];
    this.figure.hidden = !this.#plan || !this.#sweep;
    this.figure.classList.toggle("stale", isStale(this.#store, this.#plan));
    if (used.some((each, at) => each !== this.#drawn[at])) this.#stage.schedule();
    this.#drawn = used;
  }

  get #plan() {
    return this.#store.get(`plan ${this.#strategy}`);
  }

  get #sweep() {
    return this.#store.get(`shape sweep ${this.#strategy}`);
  }

  #draw(pen, width, height) {
    const [scene, sweep] = [this.#store.get("scene"), this.#sweep];
    if (!scene || !sweep) return;
    const plane = planeOf("target", scene, scene.target);
    const map = mappingOf(boxOf(scene, scene.target), width, height, STRETCH);
    this.#caption.textContent = [this.#strategy, stretchIn(map)].filter(Boolean).join(", ");
    const place = (x, y, z) => [map.toX(x), map.toY(lateral(plane, x, y, z))];
    drawScene(pen, { width, height, map, plane, name: "target", scene });
    inside(pen, width, height, () => {
      for (const [order, step] of stepsOf(sweep.paths).entries()) {
        const strength = (order + 1) / Math.min(NEEDLES, sweep.paths);
        polyline(pen, pointsOf(pathAt(sweep, step), place), { tone: `--${this.#strategy}`, width: 1.75, alpha: FAINT + (1 - FAINT) * strength });
      }
    });
  }
}

// Drawn steps: evenly spaced, with the first and the last.
function stepsOf(count) {
  const shown = Math.min(NEEDLES, count);
  return Array.from({ length: shown }, (_, at) => (shown === 1 ? count - 1 : Math.round((at * (count - 1)) / (shown - 1))));
}
