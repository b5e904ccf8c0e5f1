// One plot over time (uPlot): lines of the shown insertion and of the second run, and the player's line.

import uPlot from "../vendor/uplot.js";
import { make, shown } from "../dom.js";
import { color } from "../theme.js";

const HEIGHT = 130; // px
const FONT = "11px system-ui, 'DejaVu Sans', sans-serif";
const EXPAND = 2; // of uPlot.join: a gap ends at the known values of its own run, not at times of the other

export class PlotView {
  #spec;
  #choose;
  #place;
  #legend;
  #chart = null;
  #theme;
  #compared;
  #lines = [];
  #rows = [];
  #start = 0;
  #time = null;

  // spec: {title, lines: [{name, tone, of, dash, thin}], none: text if no value is known}; choose: called with the index of the clicked row.
  constructor(parent, spec, choose) {
    [this.#spec, this.#choose] = [spec, choose];
    this.#place = make("div.plot", { role: "img", "aria-label": spec.title });
    this.#legend = make("p.legend");
    parent.append(make("figure", {}, make("figcaption", {}, spec.title), this.#place, this.#legend));
    new ResizeObserver(([{ contentRect }]) => this.#chart?.setSize({ width: contentRect.width, height: HEIGHT })).observe(this.#place);
  }

  // Rows of the shown insertion, one at least, whose times count from `start`, and of the second run (or null) of a name, with
  // the same beginning.
  update(rows, second, start, theme, name) {
    [this.#rows, this.#start] = [rows, start];
    const compared = second?.length ? name : "";
    if (theme !== this.#theme || compared !== this.#compared) this.#make(theme, compared);
    const one = this.#columnsOf(rows, start);
    const data = compared ? joined(one, this.#columnsOf(second, second[0].time - one[0][0])) : one;
    this.#chart.setData(data);
    this.#showLegend(data);
  }

  // Move the line to a row.
  point(row) {
    const time = row.time - this.#start;
    if (time !== this.#time) {
      this.#time = time;
      this.#chart.redraw(false);
    }
    const values = this.#spec.lines.map(({ name, of }) => [name, of(row)]).filter(([, value]) => value !== null);
    const words = values.map(([name, value]) => `${name} ${shown(value, 3)}`).join(", ") || "unknown";
    const label = `${this.#spec.title} at ${shown(time, 1)} s: ${words}`;
    if (label !== this.#place.getAttribute("aria-label")) this.#place.setAttribute("aria-label", label);
  }

  #columnsOf(rows, start) {
    return [rows.map(({ time }) => time - start), ...this.#spec.lines.map(({ of }) => rows.map(of))];
  }

  // The lines that have a value, or the text if none has.
  #showLegend(data) {
    const known = this.#lines.filter((_, at) => data[at + 1].some((value) => (value ?? null) !== null));
    const none = known.length ? "" : this.#spec.none ?? "";
    const drawn = this.#lines.length > 1 ? known : [];
    const text = [none, ...drawn.map(({ name }) => name)].join();
    if (this.#legend.dataset.text === text) return;
    this.#legend.dataset.text = text;
    this.#legend.replaceChildren(none, ...drawn.map(entryOf));
  }

  #make(theme, compared) {
    [this.#theme, this.#compared] = [theme, compared];
    this.#chart?.destroy();
    const lines = compared
      ? [...this.#spec.lines, ...this.#spec.lines.map((line) => ({ ...line, name: `${line.name}, ${compared}`, tone: "--second" }))]
      : this.#spec.lines;
    this.#lines = lines;
    const axis = { stroke: color("--quiet"), font: FONT, grid: { stroke: color("--edge"), width: 1 }, ticks: { show: false } };
    const options = {
      width: this.#place.clientWidth || 300,
      height: HEIGHT,
      padding: [6, 16, 0, 0],
      scales: { x: { time: false }, y: { range: rangeOf } },
      legend: { show: false },
      cursor: { drag: { setScale: false, x: false, y: false }, y: false, points: { show: false } },
      axes: [{ ...axis, size: 24, values: (_, values) => values.map((value) => `${value} s`) }, { ...axis, size: 50, values: (_, values) => values.map((value) => String(Number(value.toPrecision(6)))) }],
      series: [{}, ...lines.map((line) => seriesOf(line))],
      hooks: { draw: [(chart) => this.#drawTime(chart)] },
    };
    this.#chart = new uPlot(options, [[], ...lines.map(() => [])], this.#place);
    this.#chart.over.addEventListener("click", () => this.#click());
  }

  #click() {
    const time = this.#chart.posToVal(this.#chart.cursor.left, "x") + this.#start;
    this.#choose(this.#rows.at(this.#rows.findIndex((row) => row.time >= time)).index); // the last one beyond the end
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

// Range around the shown values; a constant line is in the middle, not on the edge.
export function rangeOf(_chart, low, high) {
  if (low === null) return [null, null];
  if (low !== high) return uPlot.rangeNum(low, high, 0.1, true);
  const around = Math.abs(low) / 2 || 1;
  return [low - around, high + around];
}

// Columns of two runs, joined for one chart.
function joined(one, two) {
  const modes = one.map(() => EXPAND);
  return uPlot.join([one, two], [modes, modes]);
}

function seriesOf({ name, tone, dash, thin }) {
  const stroke = color(tone);
  const points = { show: false, filter: alone, size: 4, fill: stroke };
  return { label: name, stroke, width: thin ? 1 : 1.75, dash: dash ? [5, 3] : undefined, points };
}

// Indices of values between unknown ones: points, since no line contains them. Undefined values are at times of the other
// run.
function alone({ data }, series) {
  const values = data[series];
  const own = Array.from(values.keys()).filter((at) => values[at] !== undefined);
  const known = (place) => (values[own[place]] ?? null) !== null;
  return own.filter((_, place) => known(place) && !known(place - 1) && !known(place + 1));
}

function entryOf({ name, tone, dash, thin }) {
  const swatch = make(`span.swatch.${dash ? "dashed" : thin ? "thin" : "line"}`, { "aria-hidden": "true" });
  swatch.style.color = `var(${tone})`;
  return make("span", {}, swatch, name);
}
