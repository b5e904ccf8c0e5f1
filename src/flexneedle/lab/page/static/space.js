// The scene in space, to scale: tissue, guide, needle, target, predicted and true needle, paths.
// Pointer: drag turns, wheel or pinch zooms, right button shifts, arrows of the target move it. Keys: see KEYS.

import { button, make, shown } from "./dom.js";
import { SHOWN, shownRow, shownTarget } from "./shown.js";
import { stillNote } from "./still.js";
import { clearanceIn, shownNearest } from "./zones.js";

const KEYS = "Arrow keys turn, with Shift they shift the view; + and − zoom; 0 resets; 1, 2 and 3 show x–y, x–z and along the axis.";
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
const NO_WEBGL = "This browser has no WebGL, so there is no view in space. The section and the view along the axis show the same.";
const SLOW = "WebGL runs in software here, so this view is slow. The section is fast.";
const VIEWS = [["Reset", "reset", "0"], ["x–y", "side", "1"], ["x–z", "top", "2"], ["Axis", "axis", "3"]];

let view = null;

export async function mount(element, store, link) {
  const canvas = make("canvas", { tabindex: "0", role: "application", "aria-label": `The scene in space. ${KEYS}`, "aria-describedby": "space-text" });
  const context = canvas.getContext("webgl2");
  const graphics = context && nameOf(context);
  if (graphics === null) {
    store.set("view notice", NO_WEBGL);
    store.set("view scene", "section");
    return;
  }
  if (SOFTWARE.test(graphics)) element.append(make("p.quiet.notice", { role: "note" }, SLOW));

  const legend = make("ul.legend", { "aria-label": "Legend" });
  const text = make("p.spoken", { id: "space-text" });
  const tools = make("div.tools", { role: "toolbar", "aria-label": "View in space" });
  element.append(make("div.stage", {}, canvas), tools, stillNote(store), legend, text);

  const { SpaceView } = await import("./space/view.js");
  view = new SpaceView(context, legend, store, link);
  for (const [label, name, key] of VIEWS) {
    tools.append(button(label, () => view.camera.look(name), { "aria-keyshortcuts": key, title: `Key ${key}`, class: name === "axis" ? "wide" : "" }));
  }
  tools.append(
    button("+", () => view.camera.zoom(0.8), { "aria-label": "Zoom in", class: "wide" }),
    button("−", () => view.camera.zoom(1.25), { "aria-label": "Zoom out", class: "wide" }),
  );
  store.subscribe(SHOWN, () => {
    text.textContent = inWords(store);
  });
}

// The view in space of this page (space/view.js), or null before it is loaded and without WebGL. For pictures:
// `spaceView()?.drawn()`.
export function spaceView() {
  return view;
}

// Name of the graphics device.
function nameOf(context) {
  const info = context.getExtension("WEBGL_debug_renderer_info");
  return String(context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER));
}

function inWords(store) {
  const point = (values) => values.map((value) => shown(value, 1)).join(", ");
  const [target, row] = [shownTarget(store), shownRow(store)];
  const parts = [];
  if (target) parts.push(`Target at ${point(target)} mm.`);
  const near = shownNearest(store);
  if (near) parts.push(`Least clearance ${clearanceIn(near)} to ${near.zone}.`);
  if (row) parts.push(`Estimated tip at ${point(row.estimate)} mm. Error from the planned path ${shown(row.error_mm)} mm.`);
  return parts.join(" ");
}
