// Plots over time: error, guide, roll, indicator, tissue energy, predicted miss; the line is the player's period.

import { make } from "./dom.js";
import { PlotView } from "./plots/plot.js";
import { SHOWN, shownOf, shownPeriod } from "./shown.js";

const EVERY = 100; // ms between drawings
const distance = (parts) => (parts.some((each) => each === null) ? null : Math.hypot(...parts));
const lower = (row) => (row.miss_sd_mm === null ? null : Math.max(0, (distance(row.miss_mm) ?? 0) - 2 * row.miss_sd_mm));
const upper = (row) => (row.miss_sd_mm === null || distance(row.miss_mm) === null ? null : distance(row.miss_mm) + 2 * row.miss_sd_mm);

const PLOTS = [
  { title: "Error (mm)", lines: [{ name: "error", tone: "--true", of: (row) => row.error_mm }] },
  { title: "Predicted miss (mm)", lines: [
    { name: "miss", tone: "--estimate", of: (row) => distance(row.miss_mm) },
    { name: "+ 2 sd", tone: "--predicted", of: upper, thin: true },
    { name: "− 2 sd", tone: "--predicted", of: lower, thin: true },
  ] },
  { title: "Guide (mm)", lines: [
    { name: "y", tone: "--guide", of: (row) => row.guide[0] },
    { name: "z", tone: "--guide", of: (row) => row.guide[1], dash: true },
  ] },
  { title: "Roll (°)", lines: [{ name: "roll", tone: "--needle", of: (row) => row.roll_deg }] },
  { title: "Tissue energy (mJ)", lines: [
    { name: "estimated", tone: "--estimate", of: (row) => row.energy_mj },
    { name: "true", tone: "--true", of: (row) => row.true_energy_mj, dash: true },
  ] },
  { title: "Indicator", lines: [{ name: "indicator", tone: "--measured", of: (row) => row.indicator }] },
];

export function mount(element, store) {
  const nothing = make("p.quiet", {}, "Plots begin with an insertion or a recorded run.");
  const grid = make("div.plots-grid");
  element.append(nothing, grid);
  const choose = (period) => store.set("view period", period);
  let plots = null;
  let [timer, last, onScreen, drawn] = [0, 0, true, null];

  function draw() {
    timer = 0;
    last = performance.now();
    const of = shownOf(store);
    const rows = (store.get(`rows ${of}`) ?? []).filter(Boolean);
    nothing.hidden = rows.length > 0;
    grid.hidden = !rows.length;
    if (!rows.length || !onScreen) return;
    plots ??= PLOTS.map((plot) => new PlotView(grid, plot, choose));
    const second = store.get("rows second")?.filter(Boolean) ?? null;
    const [period, theme] = [shownPeriod(store, of), store.get("view theme")];
    const same = drawn && drawn.of === of && drawn.count === rows.length && drawn.first === rows[0] &&
      drawn.second === second?.length && drawn.theme === theme;
    if (!same) for (const plot of plots) plot.update(rows, second, theme);
    drawn = { of, count: rows.length, first: rows[0], second: second?.length, theme };
    for (const plot of plots) plot.point(rows[period]?.time ?? null);
  }
  function schedule() {
    timer ||= setTimeout(draw, Math.max(0, last + EVERY - performance.now()));
  }
  new IntersectionObserver(([{ isIntersecting }]) => {
    onScreen = isIntersecting;
    if (onScreen) schedule();
  }).observe(element);
  store.subscribe(SHOWN, schedule);
}
