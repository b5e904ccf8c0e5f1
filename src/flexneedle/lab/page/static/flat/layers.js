// Layers and guide of the scene with pending edits, and the edits that move them.

import { shownOf } from "../shown.js";

const THINNEST = 0.5; // mm
const NEAREST = 1; // mm, of the guide to the skin

// Layers of a scene {name, top, bottom, modulus}, with edits; the last has bottom null.
export function layersIn(scene, draft = {}) {
  let top = 0;
  return scene.layers.map(({ name, top_mm, bottom_mm, shear_modulus_kpa: modulus }, index) => {
    const thickness = draft[`tissue.${index}.thickness_mm`] ?? (bottom_mm === null ? null : bottom_mm - top_mm);
    const layer = { name, modulus, top, bottom: bottom_mm === null || thickness === null ? null : top + thickness };
    top = layer.bottom ?? top;
    return layer;
  });
}

// Edit that moves the boundary below a layer; the boundaries below it stay.
export function boundaryEdit(layers, index, x) {
  const [above, below] = [layers[index], layers[index + 1]];
  const end = below.bottom === null ? Infinity : below.bottom - THINNEST;
  const at = rounded(Math.min(Math.max(x, above.top + THINNEST), end));
  const edit = { [`tissue.${index}.thickness_mm`]: rounded(at - above.top) };
  if (below.bottom !== null) edit[`tissue.${index + 1}.thickness_mm`] = rounded(below.bottom - at);
  return edit;
}

export const layersOf = (store, scene) => layersIn(scene, draftOf(store));

// x of the guide, or null without one.
export function guideOf(store, scene) {
  const given = draftOf(store)["setup.guide_to_skin_mm"];
  return scene.guide ? (given === undefined ? scene.guide[0] : -given) : null;
}

export const guideEdit = (x) => ({ "setup.guide_to_skin_mm": rounded(Math.max(-x, NEAREST)) });

const draftOf = (store) => (shownOf(store) === "scene" ? store.get("draft") ?? {} : {});
const rounded = (value) => Math.round(100 * value) / 100;
