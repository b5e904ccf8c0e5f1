// Handles on a drawing: buttons that are dragged by pointer, or moved by the arrow keys when they have the focus.

import { make } from "../dom.js";

const STEP = 0.5; // mm, of an arrow key
const FINE = 0.1; // mm, with Shift
const ARROWS = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
export const KEYS = "Arrow keys move it by 0.5 mm, with Shift by 0.1 mm.";

export class Handles {
  #stage;
  #dropped;
  #made = new Map(); // by id: {element, handle}
  dragged = false;

  // stage: element that the handles are placed in; dropped: called when a dragged handle, or an arrow key, is released.
  constructor(stage, dropped) {
    this.#stage = stage;
    this.#dropped = dropped;
  }

  // Show handles: {id, name, at: [px, py], form, drag(px, py), nudge(right, up) in mm}.
  update(handles) {
    const ids = handles.map(({ id }) => id);
    for (const [id, { element }] of this.#made) {
      if (ids.includes(id)) continue;
      element.remove();
      this.#made.delete(id);
    }
    for (const handle of handles) {
      const made = this.#made.get(handle.id) ?? this.#make(handle);
      made.handle = handle;
      made.element.style.left = `${handle.at[0]}px`;
      made.element.style.top = `${handle.at[1]}px`;
      if (made.element.getAttribute("aria-label") !== handle.name) made.element.setAttribute("aria-label", handle.name);
    }
  }

  #make({ id, form }) {
    const element = make(`button.handle.${form}`, { type: "button", "data-handle": id, "aria-roledescription": "handle", title: KEYS });
    const made = { element, handle: null };
    let grab = null; // position of the pointer on the handle
    let moved = false; // since it was taken
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      const [x, y] = this.#placeOf(event);
      grab = [x - made.handle.at[0], y - made.handle.at[1]];
      this.dragged = true;
      moved = false;
      element.setPointerCapture(event.pointerId);
    });
    element.addEventListener("pointermove", (event) => {
      if (!grab) return;
      const [x, y] = this.#placeOf(event);
      moved = true;
      made.handle.drag(x - grab[0], y - grab[1]);
    });
    const end = () => {
      if (grab && moved) this.#dropped();
      grab = null;
      this.dragged = false;
    };
    element.addEventListener("pointerup", end);
    element.addEventListener("pointercancel", end);
    element.addEventListener("lostpointercapture", end);
    element.addEventListener("keyup", ({ key }) => ARROWS[key] && this.#dropped());
    element.addEventListener("keydown", (event) => {
      const arrow = ARROWS[event.key];
      if (!arrow || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      const step = event.shiftKey ? FINE : STEP;
      made.handle.nudge(arrow[0] * step, arrow[1] * step);
    });
    this.#stage.append(element);
    this.#made.set(id, made);
    return made;
  }

  #placeOf({ clientX, clientY }) {
    const { left, top } = this.#stage.getBoundingClientRect();
    return [clientX - left - this.#stage.clientLeft, clientY - top - this.#stage.clientTop];
  }
}
