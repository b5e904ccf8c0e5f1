// Cost over the iterations of the search (uPlot, logarithmic): the best sample, and elite and median of the samples.

import uPlot from "../vendor/uplot.js";
import { make } from "../dom.js";
import { isStale } from "../shown.js";
import { color } from "../theme.js";

const HEIGHT = 150; // px
const FONT = "11px system-ui, 'DejaVu Sans', sans-serif";
const CAPTION = "Cost over iterations: the best sample until then; elite, the highest cost of the samples from which the next iteration is drawn; the median of all samples";
const positive = (value) => (value > 0 ? value : null); // the axis is logarithmic

export class CostPlot {
  #store;
  #strategies;
  #place;
  #legend;
  #caption = make("figcaption");
  #chart = null;
  #drawn = "";

  constructor(parent, store, strategies) {
    [this.#store, this.#strategies] = [store, strategies];
    this.#place = make("div.plot", { role: "img", "aria-label": "Cost over iterations" });
    this.#legend = make("p.legend");
    this.figure = make("figure", { hidden: true }, this.#caption, this.#place, this.#legend);
    parent.append(this.figure);
    new ResizeObserver(([{ contentRect }]) => this.#chart?.setSize({ width: contentRect.width, height: HEIGHT })).observe(this.#place);
  }

  update() {
    const lines = this.#strategies.flatMap((strategy) => linesOf(strategy, this.#store.get(`iteration ${strategy}`)));
    this.figure.hidden = !lines.length;
    if (!lines.length) return;
    const stale = this.#strategies.some((strategy) => isStale(this.#store, this.#store.get(`iteration ${strategy}`)));
    this.#caption.textContent = stale ? `${CAPTION} (for an earlier state of the scenario)` : CAPTION;
    const data = dataOf(lines);
    const drawn = `${this.#store.get("view theme")} ${lines.map(({ name }) => name)}`;
    if (drawn === this.#drawn) this.#chart.setData(data);
    else this.#make(lines, data);
    this.#drawn = drawn;
  }

  #make(lines, data) {
    this.#chart?.destroy();
    const axis = { stroke: color("--quiet"), font: FONT, grid: { stroke: color("--edge"), width: 1 }, ticks: { show: false } };
    const options = {
      width: this.#place.clientWidth || 300, height: HEIGHT, padding: [6, 12, 0, 0], legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false }, y: { distr: 3 } },
      axes: [{ ...axis, size: 24, incrs: [1, 2, 5, 10, 20, 50] }, { ...axis, size: 50 }],
      series: [{}, ...lines.map(({ name, tone, dash }) => ({
        label: name, stroke: color(tone), width: dash ? 1.25 : 2, dash, points: { show: false },
      }))],
    };
    this.#chart = new uPlot(options, data, this.#place);
    this.#legend.replaceChildren(...lines.map(({ name, tone, form }) => {
      const swatch = make(`span.swatch.${form}`, { "aria-hidden": "true" });
      swatch.style.color = `var(${tone})`;
      return make("span", {}, swatch, name);
    }));
  }
}

// Lines of a strategy, of its newest iteration.
function linesOf(strategy, newest) {
  if (!newest) return [];
  const line = (name, costs, form, dash) => ({ name: `${strategy}, ${name}`, tone: `--${strategy}`, values: costs.map(positive), form, dash });
  return [
    line("best", newest.best, "line"),
    line("elite", newest.elite, "dashed", [6, 3]),
    line("median", newest.median, "dotted", [2, 4]),
  ];
}

function dataOf(lines) {
  const count = Math.max(...lines.map(({ values }) => values.length));
  const padded = lines.map(({ values }) => Array.from({ length: count }, (_, at) => values[at] ?? null));
  return [Array.from({ length: count }, (_, at) => at + 1), ...padded];
}
