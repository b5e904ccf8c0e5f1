// Plots over time: error, miss, clearance, guide, roll, indicator, tissue energy, predicted miss; the line is the player's period.
// The error is the true tip's on a virtual rig, the estimated tip's on a rig.

import { make } from "./dom.js";
import { PlotView } from "./plots/plot.js";
import { SHOWN, shownOf, shownRow, startOf } from "./shown.js";

const EVERY = 100; // ms between drawings
const distance = (parts) => (parts.some((each) => each === null) ? null : Math.hypot(...parts));
const bound = (sign) => ({ miss_mm: miss, miss_sd_mm: sd }) => (distance([...miss, sd]) === null ? null : Math.max(0, distance(miss) + sign * 2 * sd));

const PLOTS = [
  { title: "Error from the planned path (mm)", lines: [
    { name: "true tip", tone: "--true", of: (row) => (row.true ? row.error_mm : null) },
    { name: "estimated tip", tone: "--estimate", of: (row) => (row.true ? null : row.error_mm) },
  ] },
  { title: "Predicted miss at the target (mm)", lines: [
    { name: "miss", tone: "--estimate", of: (row) => distance(row.miss_mm) },
    { name: "+ 2 standard deviations", tone: "--predicted", of: bound(1), thin: true },
    { name: "− 2 standard deviations", tone: "--predicted", of: bound(-1), thin: true },
  ] },
  { title: "Clearance from zones (mm)", none: "There are no zones to avoid.", lines: [
    { name: "estimated", tone: "--estimate", of: (row) => row.clearance_mm },
    { name: "true", tone: "--true", of: (row) => row.true_clearance_mm, dash: true },
    { name: "least margin", tone: "--bad", of: (row) => row.margin_mm ?? null, thin: true },
  ] },
  { title: "Guide (mm)", lines: [
    { name: "y", tone: "--guide", of: (row) => row.guide[0] },
    { name: "z", tone: "--guide", of: (row) => row.guide[1], dash: true },
  ] },
  { title: "Roll (°)", lines: [{ name: "roll", tone: "--needle", of: (row) => row.roll_deg }] },
  { title: "Tissue energy (µJ)", lines: [
    { name: "estimated", tone: "--estimate", of: (row) => row.energy_uj },
    { name: "true", tone: "--true", of: (row) => row.true_energy_uj, dash: true },
  ] },
  {
    title: "Tracker's largest indicator of distortion", none: "This tracker has no indicator.",
    lines: [{ name: "indicator", tone: "--measured", of: (row) => row.indicator }],
  },
];

export function mount(element, store) {
  const nothing = make("p.quiet", {}, "Plots begin with an insertion or a recorded run.");
  const grid = make("div.plots-grid");
  element.append(nothing, grid);
  const choose = (period) => store.set("view period", period);
  let plots = null;
  let [timer, last, onScreen, drawn] = [0, 0, true, []];

  function draw() {
    timer = 0;
    last = performance.now();
    const of = shownOf(store);
    const rows = store.get(`rows ${of}`) ?? [];
    nothing.hidden = rows.length > 0;
    grid.hidden = !rows.length;
    if (!rows.length || !onScreen) return;
    plots ??= PLOTS.map((plot) => new PlotView(grid, plot, choose));
    const data = [rows, store.get("rows second") ?? null, startOf(store, of), store.get("view theme"), store.get("insertion second")?.name];
    if (data.some((each, at) => each !== drawn[at])) for (const plot of plots) plot.update(...data);
    drawn = data;
    for (const plot of plots) plot.point(shownRow(store, of));
  }
  function schedule() {
    timer ||= setTimeout(draw, Math.max(0, last + EVERY - performance.now()));
  }
  new IntersectionObserver((entries) => {
    onScreen = entries.at(-1).isIntersecting; // the newest: a busy browser reports several at once
    if (onScreen) schedule();
  }).observe(element);
  store.subscribe(SHOWN, schedule);
}
