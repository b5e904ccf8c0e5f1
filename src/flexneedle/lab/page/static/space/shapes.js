// Moving parts: needle, predicted and true needle, cut channel, paths, samples, reach, guide and bevel.

import {
  Color, ConeGeometry, CylinderGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial, MeshLambertMaterial, SRGBColorSpace,
  Vector3,
} from "../vendor/three.js";
import { planeOf } from "../flat/plane.js";
import { isIn } from "../flat/reach.js";
import { first, pathOfRows, ranksOf, tipOf } from "../paths.js";
import { foreseen, plannedPaths, rollOf, sampledPaths } from "../planned.js";
import { isMeasured, shownReach, shownRow, shownSecond, shownShape, shownTarget } from "../shown.js";
import { Lines } from "./lines.js";
import { Outlines } from "./outlines.js";
import { paint } from "./room.js";
import { Tube } from "./tube.js";

const PATH = 0.14; // mm, radius of a path
const CHANNEL = 1.7; // radius of the channel by the needle's
const STALE = 0.35; // opacity of a path that was planned for an earlier state of the scenario
const [BEVEL, GUIDE, READING] = [6, 6, 2]; // mm, lengths
// Stretch of the tissue from low to high, distinguishable by lightness alone.
const STRETCH = [[0.99, 0.88, 0.68], [0.90, 0.62, 0.0], [0.84, 0.37, 0.0], [0.45, 0.11, 0.0]];

export class Shapes {
  #tubes = {};
  #paths = new Lines(); // sampled ones
  #outlines = new Outlines();
  #reading;
  #theme = "";
  #seen = new Map(); // by part: its data

  constructor() {
    this.group = new Group();
    const solid = { needle: "--needle", second: "--second" };
    for (const [name, tone] of Object.entries(solid)) this.#addTube(name, new MeshLambertMaterial(), tone, 0);
    for (const name of ["path", "other", "estimated", "truth", "secondPath", "true", "foreseen"]) {
      this.#addTube(name, new MeshBasicMaterial({ transparent: true }), `--${name}`, 3);
    }
    this.#addTube("channel", translucent({ vertexColors: true, opacity: 0.8 }), null, 4);
    this.#addTube("predicted", translucent({ opacity: 0.24 }), "--predicted", 5);
    this.#addGuide();
    this.#addBevel();
    this.#addMeasured();
    this.#paths.object.renderOrder = 2;
    const named = { guide: this.guide, bevel: this.bevel, measured: this.measured, samples: this.#paths.object, reach: this.#outlines.group };
    for (const [name, object] of Object.entries(named)) object.name = name;
    this.group.add(this.#paths.object, this.#outlines.group);
  }

  // Draw the state of the store. Return entries of the legend: {text, tone, form} and for the channel {text, ramp}.
  update(store, scene, of) {
    const row = shownRow(store);
    const shape = (kind) => shownShape(store, kind, of);
    const theme = store.get("view theme");
    if (theme !== this.#theme) this.#seen.clear();
    this.#theme = theme;
    const entries = [
      this.#needle(scene, shape("needle")),
      this.#true(scene, shape("true")),
      this.#predicted(scene, foreseen(store, of)),
      this.#channel(scene, shape("channel")),
      ...this.#plans(store, of),
      this.#samples(store, of),
      ...this.#tips(store, of, row),
      this.#measured(row),
      this.#second(store, scene),
      this.#reach(store, scene),
    ];
    this.#place(scene, row, shape("needle"), rollOf(store, of));
    return entries.filter(Boolean);
  }

  #addTube(name, material, tone, order) {
    const tube = new Tube(material);
    tube.mesh.name = name;
    tube.mesh.renderOrder = order;
    tube.tone = tone;
    this.#tubes[name] = tube;
    this.group.add(tube.mesh);
  }

  #addGuide() {
    const material = translucent({ opacity: 0.55, side: DoubleSide });
    this.guide = new Mesh(new CylinderGeometry(1.6, 1.6, GUIDE, 24, 1, true), material);
    this.guide.rotation.z = Math.PI / 2;
    this.guide.renderOrder = 6;
    this.group.add(this.guide);
  }

  #addBevel() {
    const material = new MeshBasicMaterial({ depthTest: false, transparent: true });
    const shaft = new Mesh(new CylinderGeometry(0.12, 0.12, BEVEL - 1.5, 8), material);
    const head = new Mesh(new ConeGeometry(0.5, 1.5, 12), material);
    shaft.position.y = (BEVEL - 1.5) / 2;
    head.position.y = BEVEL - 0.75;
    shaft.renderOrder = head.renderOrder = 8;
    this.bevel = new Group();
    this.bevel.add(shaft, head);
    this.group.add(this.bevel);
  }

  // Bars along the diagonals of a cube: a cross from all sides, as in the flat views.
  #addMeasured() {
    this.#reading = new MeshBasicMaterial({ depthTest: false, transparent: true });
    const bar = new CylinderGeometry(0.09, 0.09, READING, 6);
    this.measured = new Group();
    for (const [y, z] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
      const mesh = new Mesh(bar, this.#reading);
      mesh.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), new Vector3(1, y, z).normalize());
      mesh.renderOrder = 7;
      this.measured.add(mesh);
    }
    this.group.add(this.measured);
  }

  // Return whether the data of a part has changed.
  #differs(part, inputs) {
    const before = this.#seen.get(part);
    this.#seen.set(part, inputs);
    return !before || inputs.length !== before.length || inputs.some((input, at) => !Object.is(input, before[at]));
  }

  // Update a tube where its path differs; `tone` names its colour.
  #draw(name, path, radius, { tone = this.#tubes[name].tone, opacity, color } = {}) {
    const tube = this.#tubes[name];
    if (!this.#differs(name, [path, tone, opacity, typeof radius === "number" ? radius : 0])) return;
    tube.update(path, radius, color);
    if (tone) tube.mesh.material.color = paint(tone);
    if (opacity !== undefined) tube.mesh.material.opacity = opacity;
  }

  #needle(scene, path) {
    this.#draw("needle", first(path), scene.needle_radius_mm);
    return path && { text: "needle", tone: "--needle", form: "thick" };
  }

  #true(scene, path) {
    this.#draw("true", first(path), 0.4 * scene.needle_radius_mm, { opacity: 0.9 });
    this.#tubes.true.mesh.material.depthTest = false;
    return path && { text: "true needle", tone: "--true" };
  }

  #predicted(scene, { path, text, spread }) {
    const radius = scene.needle_radius_mm;
    this.#draw("foreseen", path, 0.5 * radius, { tone: "--predicted", opacity: 0.6 });
    this.#draw("predicted", spread ? path : null, (point) => radius + spread * path.values[point * path.columns + 3]);
    return path && { text, tone: "--predicted", form: spread ? "area" : "line" };
  }

  #channel(scene, path) {
    const cut = first(path);
    const stretch = cut ? Array.from({ length: cut.points }, (_, at) => cut.values[at * cut.columns + 3]) : [];
    const most = Math.max(1.05, ...stretch);
    const color = (point, into, at) => into.set(rampAt((stretch[point] - 1) / (most - 1)), at);
    this.#draw("channel", cut, CHANNEL * scene.needle_radius_mm, { color });
    return cut && { text: `stretch of the tissue, 1 to ${most.toFixed(2)}`, ramp: STRETCH };
  }

  #plans(store, of) {
    const { chosen, other } = plannedPaths(store, of);
    for (const [name, planned] of Object.entries({ path: chosen, other })) {
      this.#draw(name, planned?.path ?? null, PATH, { tone: planned?.tone ?? "--plan", opacity: planned?.stale ? STALE : 1 });
    }
    return [chosen, other].map((planned) => planned && { text: planned.text, tone: planned.tone });
  }

  // Sampled paths: the cheaper, the stronger.
  #samples(store, of) {
    const shape = of === "scene" ? sampledPaths(store) : shownShape(store, "samples", of);
    if (this.#differs("samples", [shape])) {
      const rank = shape ? ranksOf(shape) : [];
      this.#paths.update(shape, paint("--estimate"), (path) => 0.55 - 0.45 * rank[path]);
    }
    return shape && { text: `${shape.paths} sampled paths`, tone: "--estimate", form: "thin" };
  }

  // Past positions of the tip: estimated and true.
  #tips(store, of, row) {
    const rows = row && of !== "scene" ? store.get(`rows ${of}`).slice(0, row.index + 1) : [];
    const count = rows.length;
    if (this.#differs("tips", [of, count, rows[0]])) {
      this.#draw("estimated", pathOfRows(rows, "estimate"), PATH, { tone: "--estimate" });
      this.#draw("truth", pathOfRows(rows, "true"), PATH, { tone: "--true" });
    }
    const estimated = { text: "estimated path of the tip", tone: "--estimate" };
    const truth = rows.some((each) => each?.true) && { text: "true path of the tip", tone: "--true" };
    return count > 1 ? [estimated, truth] : [];
  }

  // Measured tip at the shown period.
  #measured(row) {
    this.measured.visible = isMeasured(row);
    if (!this.measured.visible) return null;
    this.measured.position.set(...row.measured);
    this.#reading.color = paint("--measured");
    return { text: "measured tip", tone: "--measured", form: "cross" };
  }

  #second(store, scene) {
    const second = shownSecond(store);
    this.#draw("second", first(second?.shape("needle")), scene.needle_radius_mm);
    const rows = second?.row ? store.get("rows second").slice(0, second.row.index + 1) : [];
    if (this.#differs("second tips", [rows.length, rows[0]])) {
      this.#draw("secondPath", pathOfRows(rows, "estimate"), PATH, { tone: "--second" });
    }
    return second && { text: `run ${second.name}`, tone: "--second" };
  }

  // Its strip is in the plane of the target for which it was computed; a target that was moved may be outside.
  #reach(store, scene) {
    const reach = shownReach(store);
    const outlines = reach && store.get("shape reach scene");
    const strip = Boolean(reach) && isIn(planeOf("target", scene, shownTarget(store)), reach);
    if (this.#differs("reach", [reach, strip, outlines])) this.#outlines.update(reach, strip, outlines ?? null, paint("--reach"));
    return reach && { text: "reach", tone: "--reach", form: strip ? "area" : "line" };
  }

  #place(scene, row, needle, roll) {
    this.guide.visible = Boolean(scene.guide);
    if (scene.guide) this.guide.position.set(scene.guide[0], ...(row?.guide ?? scene.guide.slice(1)));
    this.guide.material.color = paint("--guide");
    const tip = needle && tipOf(first(needle));
    this.bevel.visible = Boolean(tip);
    if (!tip) return;
    const angle = (roll * Math.PI) / 180; // from y to z
    this.bevel.position.set(...tip);
    this.bevel.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), new Vector3(0, Math.cos(angle), Math.sin(angle)));
    this.bevel.children[0].material.color = paint("--ink");
  }
}

const translucent = (how) => new MeshBasicMaterial({ transparent: true, depthWrite: false, ...how });

// Colour of the stretch scale at a share from 0 to 1, linear as three.js takes colours of vertices, not as on a screen.
function rampAt(share) {
  const place = Math.min(Math.max(share, 0), 1) * (STRETCH.length - 1);
  const low = Math.min(Math.floor(place), STRETCH.length - 2);
  const onScreen = STRETCH[low].map((value, at) => value + (place - low) * (STRETCH[low + 1][at] - value));
  return new Color().setRGB(...onScreen, SRGBColorSpace).toArray();
}
