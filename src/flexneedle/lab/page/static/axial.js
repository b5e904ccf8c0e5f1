// The view along the axis, as the needle moves: z to the right, y upwards; the target is moved here.

import { make, shown } from "./dom.js";
import { drawAxial, endsOf } from "./flat/axial.js";
import { KEYS, Handles } from "./flat/handles.js";
import { entriesOf, measuredEntries, partsOf } from "./flat/parts.js";
import { mappingOf } from "./flat/plane.js";
import { Stage } from "./flat/stage.js";
import { showLegend } from "./legend.js";
import { SHOWN, STEERING, mayMove, otherTargets, shownScene, shownTarget, targetEdit } from "./shown.js";

const [LEAST, AROUND, EDGE] = [4, 3, 0.5]; // mm; around the target, around the reach

// Half of the shown width (mm): the targets with room to move them, and the reach.
function halfAround(targets, ends) {
  const far = ([, y, z]) => Math.max(Math.abs(y), Math.abs(z));
  return Math.max(LEAST, ...targets.map((target) => Math.ceil(far(target) + AROUND)), ...ends.map((end) => Math.ceil(far(end) + EDGE)));
}

export function mount(element, store, link) {
  const canvas = make("canvas", { role: "img", "aria-label": "View along the axis" });
  const place = make("div.stage", {}, canvas);
  const legend = make("ul.legend", { "aria-label": "Legend of the view along the axis" });
  element.append(place, legend);
  const handles = new Handles(place, () => link.rest());
  let half = LEAST; // mm, stays while the target is dragged

  const stage = new Stage(canvas, (pen, { width, height }) => {
    const [scene, target] = [shownScene(store), shownTarget(store)];
    if (!scene || !target) return;
    const [ends, others] = [endsOf(store, target), otherTargets(store)];
    if (!handles.dragged) half = halfAround([target, ...others.map(({ position }) => position)], ends);
    const map = mappingOf({ left: -half, right: half, half }, width, height, 1);
    const parts = partsOf(store, scene);
    const reached = drawAxial(pen, { width, height, map, scene, target, others, parts, ends, store });
    showLegend(legend, entriesOf([...parts, ...measuredEntries(store)], reached), others);
    handles.update(mayMove(store) ? [handleOf(map, scene, target)] : []);
  });
  store.subscribe([...SHOWN, ...STEERING], () => stage.schedule());

  function handleOf(map, { axes }, target) {
    const move = (y, z) => {
      const [x, , out] = shownTarget(store); // now: keys may be faster than the drawing
      link.edit(targetEdit(store, [x, y, axes === 2 ? z : out]));
    };
    return {
      id: "target", form: "point", at: [map.toX(target[2]), map.toY(target[1])],
      name: `Target: y ${shown(target[1])} mm, z ${shown(target[2])} mm. ${KEYS}`,
      drag: (px, py) => move(map.fromY(py), map.fromX(px)),
      nudge: (right, up) => {
        const [, y, z] = shownTarget(store);
        move(y + up, z + right);
      },
    };
  }
}
