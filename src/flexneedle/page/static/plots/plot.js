// One plot over time (uPlot): lines of the shown insertion, those of the second run beside them, the player's line.

import uPlot from "../vendor/uplot.js";
import { make, shown } from "../dom.js";
import { color } from "../theme.js";

const HEIGHT = 130; // px
const FONT = "11px system-ui, 'DejaVu Sans', sans-serif";

export class PlotView {
  #spec;
  #choose;
  #place;
  #legend;
  #chart = null;
  #theme;
  #compared;
  #rows = [];
  #time = null;

  // spec: {title, lines: [{name, tone, of, dash, thin}]}; choose: called with the index of the row that is clicked.
  constructor(parent, spec, choose) {
    [this.#spec, this.#choose] = [spec, choose];
    this.#place = make("div.plot", { role: "img", "aria-label": spec.title });
    this.#legend = make("p.legend");
    parent.append(make("figure", {}, make("figcaption", {}, spec.title), this.#place, this.#legend));
    new ResizeObserver(([{ contentRect }]) => this.#chart?.setSize({ width: contentRect.width, height: HEIGHT })).observe(this.#place);
  }

  // Rows of the shown insertion and of the second run (or null).
  update(rows, second, theme) {
    this.#rows = rows;
    const compared = Boolean(second?.length);
    if (theme !== this.#theme || compared !== this.#compared) this.#make(theme, compared);
    this.#chart.setData(this.#dataOf(rows, second));
  }

  // Move the line to a time.
  point(time) {
    if (time === this.#time) return;
    this.#time = time;
    this.#chart?.redraw(false);
    this.#place.setAttribute("aria-label", `${this.#spec.title}${this.#inWords(time)}`);
  }

  #inWords(time) {
    const row = this.#rows.findLast((each) => each.time <= time);
    if (!row) return "";
    return ` at ${shown(time, 1)} s: ${this.#spec.lines.map(({ name, of }) => `${name} ${shown(of(row), 3)}`).join(", ")}`;
  }

  #dataOf(rows, second) {
    const { lines } = this.#spec;
    const one = [rows.map(({ time }) => time), ...lines.map(({ of }) => rows.map(of))];
    if (!second?.length) return one;
    const later = (rows[0]?.time ?? 0) - second[0].time; // a rig's clock begins before its first period
    const two = [second.map(({ time }) => time + later), ...lines.map(({ of }) => second.map(of))];
    return uPlot.join([one, two]);
  }

  #make(theme, compared) {
    [this.#theme, this.#compared] = [theme, compared];
    this.#chart?.destroy();
    const lines = compared
      ? [...this.#spec.lines, ...this.#spec.lines.map((line) => ({ ...line, name: `${line.name}, second`, tone: "--second" }))]
      : this.#spec.lines;
    const axis = { stroke: color("--quiet"), font: FONT, grid: { stroke: color("--edge"), width: 1 }, ticks: { show: false } };
    const options = {
      width: this.#place.clientWidth || 300,
      height: HEIGHT,
      padding: [6, 16, 0, 0],
      scales: { x: { time: false } },
      legend: { show: false },
      cursor: { drag: { setScale: false, x: false, y: false }, y: false, points: { show: false } },
      axes: [{ ...axis, size: 24, values: (_, values) => values.map((value) => `${value} s`) }, { ...axis, size: 50, values: (_, values) => values.map((value) => String(Number(value.toPrecision(6)))) }],
      series: [{}, ...lines.map((line) => seriesOf(line))],
      hooks: { draw: [(chart) => this.#drawTime(chart)] },
    };
    this.#chart = new uPlot(options, [[], ...lines.map(() => [])], this.#place);
    this.#chart.over.addEventListener("click", () => this.#click());
    this.#legend.replaceChildren(...(lines.length > 1 ? lines.map(entryOf) : []));
  }

  #click() {
    const time = this.#chart.posToVal(this.#chart.cursor.left, "x");
    const at = this.#rows.findIndex((row) => row.time >= time);
    this.#choose(this.#rows.at(at)?.index ?? 0);
  }

  #drawTime({ ctx, bbox, valToPos }) {
    if (this.#time === null) return;
    const x = Math.round(valToPos(this.#time, "x", true)) + 0.5;
    ctx.save();
    ctx.strokeStyle = color("--ink");
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.restore();
  }
}

function seriesOf({ name, tone, dash, thin }) {
  return {
    label: name, stroke: color(tone), width: thin ? 1 : 1.75, dash: dash ? [5, 3] : undefined, points: { show: false }, spanGaps: true,
  };
}

function entryOf({ name, tone, dash, thin }) {
  const swatch = make(`span.swatch.${dash ? "dashed" : thin ? "thin" : "line"}`, { "aria-hidden": "true" });
  swatch.style.color = `var(${tone})`;
  return make("span", {}, swatch, name);
}
