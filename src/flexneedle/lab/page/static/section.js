// The scene in section: x–y, x–z, or the plane through axis and target. Target, guide, boundaries, zones and entry are moved here.

import { boxOf } from "./box.js";
import { button, make, shown } from "./dom.js";
import { KEYS, Handles } from "./flat/handles.js";
import { boundaryEdit, guideEdit, guideOf, layersOf } from "./flat/layers.js";
import { entriesOf, measuredEntries, partsOf } from "./flat/parts.js";
import { lateral, lifted, mappingOf, planeOf } from "./flat/plane.js";
import { drawSection, outlineOf } from "./flat/section.js";
import { Stage } from "./flat/stage.js";
import { showLegend } from "./legend.js";
import { pointEntries } from "./sensors.js";
import { SHOWN, STEERING, mayMove, otherTargets, shownScene, shownTarget, targetEdit } from "./shown.js";
import { stillNote } from "./still.js";
import { entryEdit, entryOf, shownNearest, shownZones, zoneEdit, zoneEntries } from "./zones.js";

const PLANES = [["x–y", "x–y"], ["x–z", "x–z"], ["Target", "target"]];
const STRETCHES = [1, 2, 5];
const EDGE = 1; // mm, around the reach

let view = null;

export function mount(element, store, link) {
  const canvas = make("canvas", { role: "img", "aria-label": "Section of the scene" });
  const stage = make("div.stage", {}, canvas);
  const legend = make("ul.legend", { "aria-label": "Legend of the section" });
  view = new SectionView(canvas, stage, legend, store, link);
  const planes = PLANES.map(([text, name]) => button(text, () => view.choose(name), { "data-plane": name, title: name === "target" ? "The plane through the axis and the target" : `The plane ${name}` }));
  const stretch = make("select.wide", { "aria-label": "Stretch of the lateral axis", change: () => view.stretchBy(Number(stretch.value)) });
  stretch.append(...STRETCHES.map((each) => make("option", { value: String(each) }, each === 1 ? "to scale" : `lateral ×${each}`)));
  element.append(stage, make("div.tools", { role: "toolbar", "aria-label": "Section" }, ...planes, stretch), stillNote(store), legend);
  view.changed = () => {
    for (const each of planes) each.setAttribute("aria-pressed", String(each.dataset.plane === view.plane));
  };
  view.changed();
}

// The section of this page, or null before it is loaded. For pictures: `sectionView().drawn()`.
export function sectionView() {
  return view;
}

class SectionView {
  #stage;
  #handles;
  #legend;
  #store;
  #link;
  #stretch = 1;
  #box = null;
  #frozen = null; // plane during a drag
  plane = "target";
  changed = () => {};

  constructor(canvas, stage, legend, store, link) {
    [this.#legend, this.#store, this.#link] = [legend, store, link];
    this.#handles = new Handles(stage, () => link.rest());
    this.#stage = new Stage(canvas, (pen, { width, height }) => this.#draw(pen, width, height));
    store.subscribe([...SHOWN, ...STEERING], () => this.#stage.schedule());
  }

  choose(plane) {
    this.plane = plane;
    this.changed();
    this.#stage.schedule();
  }

  stretchBy(factor) {
    this.#stretch = factor;
    this.#stage.schedule();
  }

  // Draw the section and return its canvas.
  drawn() {
    return this.#stage.drawn();
  }

  #draw(pen, width, height) {
    const [scene, target] = [shownScene(this.#store), shownTarget(this.#store)];
    if (!scene || !target) return;
    const plane = this.#handles.dragged ? this.#frozen : planeOf(this.plane, scene, target);
    const others = otherTargets(this.#store);
    const outline = outlineOf(plane, this.#store);
    if (!this.#handles.dragged) {
      [this.#frozen, this.#box] = [plane, around(boxOf(scene, target, others), outline)];
      this.#stage.canvas.closest(".section").dataset.target = lateral(plane, ...target) > 0 ? "above" : "below"; // the axis
    }
    const map = mappingOf(this.#box, width, height, this.#stretch);
    const [layers, guide] = [layersOf(this.#store, scene), guideOf(this.#store, scene)];
    const parts = partsOf(this.#store, scene);
    const [zones, near] = [shownZones(this.#store), shownNearest(this.#store)];
    const reached = drawSection(pen, { width, height, map, plane, name: this.plane, layers, guide, scene, target, others, parts, outline, zones, near, store: this.#store });
    showLegend(this.#legend, [...entriesOf([...parts, ...measuredEntries(this.#store)], reached), ...pointEntries(this.#store), ...zoneEntries(zones, near, scene.axes === 2)], others);
    this.#handles.update(mayMove(this.#store) ? [...this.#handlesOf({ map, plane, layers, guide, target, height }), ...this.#zoneHandles({ map, plane, zones })] : []);
  }

  #handlesOf({ map, plane, layers, guide, target, height }) {
    const edit = (values) => this.#link.edit(values);
    const u = lateral(plane, ...target);
    // Target and scene are read when a handle moves: keys may be faster than the drawing.
    const [targetNow, sceneNow] = [() => shownTarget(this.#store), () => shownScene(this.#store)];
    const move = (x, to) => edit(targetEdit(this.#store, lifted(plane, x, to, targetNow())));
    const handles = [{
      id: "target", form: "point", at: [map.toX(target[0]), map.toY(u)],
      name: `Target: depth ${shown(target[0])} mm, lateral ${target.slice(1).map((each) => shown(each)).join(" and ")} mm. ${KEYS}`,
      drag: (px, py) => move(map.fromX(px), map.fromY(py)),
      nudge: (right, up) => move(targetNow()[0] + right, lateral(plane, ...targetNow()) + up),
    }];
    if (guide !== null) {
      handles.push({
        id: "guide", form: "bar", at: [map.toX(guide), height - 30], name: `Guide: ${shown(-guide)} mm before the skin. ${KEYS}`,
        drag: (px) => edit(guideEdit(map.fromX(px))), nudge: (right) => edit(guideEdit(guideOf(this.#store, sceneNow()) + right)),
      });
    }
    layers.slice(0, -1).forEach(({ name, bottom }, index) => {
      const layersNow = () => layersOf(this.#store, sceneNow());
      const move = (x) => edit(boundaryEdit(layersNow(), index, x));
      handles.push({
        id: `boundary-${index}`, form: "bar", at: [map.toX(bottom), height - 30],
        name: `Boundary between ${name} and ${layers[index + 1].name}: depth ${shown(bottom)} mm. ${KEYS}`,
        drag: (px) => move(map.fromX(px)), nudge: (right) => move(layersNow()[index].bottom + right),
      });
    });
    return handles;
  }

  // Handles of zones that can be moved, and of the entry. What moves stays as far from the plane.
  #zoneHandles({ map, plane, zones }) {
    const point = (id, form, name, placeNow, editTo) => {
      const move = (x, u) => this.#link.edit(editTo(lifted(plane, x, u, placeNow())));
      const [x, ...out] = placeNow();
      return {
        id, form: `point.${form}`, name: `${name}: depth ${shown(x)} mm, lateral ${out.map((each) => shown(each)).join(" and ")} mm. ${KEYS}`,
        at: [map.toX(x), map.toY(lateral(plane, x, ...out))],
        drag: (px, py) => move(map.fromX(px), map.fromY(py)),
        nudge: (right, up) => move(placeNow()[0] + right, lateral(plane, ...placeNow()) + up),
      };
    };
    const movable = zones.filter(({ center }) => center);
    return [
      ...movable.map(({ name, number }) => point(`zone-${number}`, "zone", `Zone ${name}`, () => shownZones(this.#store)[number].center, (to) => zoneEdit(this.#store, number, to))),
      point("entry", "entry", "Entry", () => entryOf(this.#store), (to) => entryEdit(this.#store, to)),
    ];
  }
}

// A box with room for the outline of the reach, too.
function around({ left, right, half }, outline) {
  const most = (values) => Math.ceil(Math.max(...values) + EDGE);
  return { left, right: most([right - EDGE, ...outline.map(([x]) => x)]), half: most([half - EDGE, ...outline.map(([, u]) => Math.abs(u))]) };
}
