// Cost over the iterations of the search (uPlot, logarithmic): the best so far, and elite and median of the samples.

import uPlot from "../vendor/uplot.js";
import { make } from "../dom.js";
import { color } from "../theme.js";

const HEIGHT = 150; // px
const FONT = "11px system-ui, 'DejaVu Sans', sans-serif";
const CAPTION = "Cost over iterations: best so far; elite: the worst sample that the next iteration is fitted to; median of the samples";
const [ELITE, MEDIAN] = [1, 2]; // of the quantiles
const positive = (value) => (value > 0 ? value : null); // the axis is logarithmic

export class CostPlot {
  #store;
  #strategies;
  #iterations = {}; // by strategy: by number
  #place;
  #legend;
  #chart = null;
  #drawn = "";

  constructor(parent, store, strategies) {
    [this.#store, this.#strategies] = [store, strategies];
    this.#place = make("div.plot", { role: "img", "aria-label": "Cost over iterations" });
    this.#legend = make("p.legend");
    this.figure = make("figure", { hidden: true }, make("figcaption", {}, CAPTION), this.#place, this.#legend);
    parent.append(this.figure);
    new ResizeObserver(([{ contentRect }]) => this.#chart?.setSize({ width: contentRect.width, height: HEIGHT })).observe(this.#place);
  }

  update() {
    for (const strategy of this.#strategies) this.#take(strategy);
    const known = this.#strategies.filter((strategy) => this.#best(strategy).length);
    this.figure.hidden = !known.length;
    if (!known.length) return;
    const lines = known.flatMap((strategy) => this.#linesOf(strategy));
    const data = dataOf(lines);
    const drawn = `${this.#store.get("view theme")} ${lines.map(({ name }) => name)}`;
    if (drawn === this.#drawn) this.#chart.setData(data);
    else this.#make(lines, data);
    this.#drawn = drawn;
  }

  // Keep the newest iteration; those before it stay while it is the same search.
  #take(strategy) {
    const newest = this.#store.get(`iteration ${strategy}`);
    const known = this.#iterations[strategy] ?? [];
    if (!newest) delete this.#iterations[strategy];
    else if (known.at(-1) !== newest) {
      const goesOn = known.at(-1)?.revision === newest.revision && known.length <= newest.iteration;
      const list = goesOn ? known : [];
      list[newest.iteration] = newest;
      this.#iterations[strategy] = list;
    }
  }

  #best(strategy) {
    const [list, plan] = [this.#iterations[strategy] ?? [], this.#store.get(`plan ${strategy}`)];
    const running = list.at(-1)?.revision > (plan?.revision ?? -1);
    return plan && !running ? plan.history : Array.from(list, (each) => each?.best ?? null);
  }

  #linesOf(strategy) {
    const list = this.#iterations[strategy] ?? [];
    const quantile = (at) => Array.from(list, (each) => each?.quantiles[at] ?? null);
    const line = (name, values, form, dash) => ({ name: `${strategy}, ${name}`, tone: `--${strategy}`, values: values.map(positive), form, dash });
    return [
      line("best", this.#best(strategy), "line"),
      line("elite", quantile(ELITE), "dashed", [6, 3]),
      line("median", quantile(MEDIAN), "dotted", [2, 4]),
    ];
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
        label: name, stroke: color(tone), width: dash ? 1.25 : 2, dash, points: { show: false }, spanGaps: true,
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

function dataOf(lines) {
  const count = Math.max(...lines.map(({ values }) => values.length));
  const padded = lines.map(({ values }) => Array.from({ length: count }, (_, at) => values[at] ?? null));
  return [Array.from({ length: count }, (_, at) => at + 1), ...padded];
}
