// Plans: search, both strategies side by side with their costs, as in the paper's figure, reach; cost over iterations.

import { button, make, renew, shown } from "./dom.js";
import { CostPlot } from "./plans/cost.js";
import { SweepView } from "./plans/sweep.js";
import { termsTable } from "./plans/terms.js";
import { STRATEGIES, planWords } from "./plans/words.js";
import { STEERING, allow, shownReach } from "./shown.js";

const WORK = [["Both strategies", "compare"], ["Reach", "reach"]];
const ACTIVE = ["waiting", "running"];

export function mount(element, store, link) {
  const starts = WORK.map(([text, work]) => button(text, () => link.ask({ type: "start", work }), { "data-work": work }));
  const cancel = button("Cancel", () => activeJobs(store).forEach(({ job }) => link.ask({ type: "cancel", job })), { hidden: true });
  const progress = make("progress", { max: "1", "aria-label": "Progress of the plan", hidden: true });
  const words = make("ul.words", { role: "status" });
  const cost = make("div.cost");
  const figures = make("div.sweeps");
  const table = make("div");
  element.append(make("div.tools", { role: "toolbar", "aria-label": "Plan" }, ...starts, cancel, progress), words, cost, figures, table);

  const plot = new CostPlot(cost, store, STRATEGIES);
  const sweeps = STRATEGIES.map((strategy) => new SweepView(figures, store, strategy));
  store.subscribe(STEERING, () => {
    for (const each of starts) allow(store, each);
  });
  store.subscribe(["job ", ...STEERING], () => {
    const [job] = activeJobs(store);
    cancel.hidden = progress.hidden = !job;
    allow(store, cancel);
    if ((job?.share ?? null) === null) progress.removeAttribute("value");
    else progress.value = job.share;
  });
  store.subscribe(["session", "estimate", "plan ", "reach", "view of", "insertion "], () => {
    renew(words, lines(store).map(([text, stale]) => make("li", { class: stale ? "quiet" : "" }, text)));
  });
  store.subscribe(["session", "plan ", "iteration ", "view theme"], () => plot.update());
  store.subscribe(["session", "scene", "plan ", ...STRATEGIES.map((strategy) => `shape sweep ${strategy}`), "view theme"], () => {
    for (const sweep of sweeps) sweep.update();
  });
  store.subscribe(["plan "], () => {
    table.replaceChildren(...termsTable(STRATEGIES.map((strategy) => store.get(`plan ${strategy}`)).filter(Boolean)));
  });
}

const activeJobs = (store) => ["plan", "compare", "reach"].map((kind) => store.get(`job ${kind}`)).filter((job) => job && ACTIVE.includes(job.state));

function lines(store) {
  const reach = shownReach(store);
  const words = reach ? [[`Reach: found by small searches ${depth(reach.low[0])} to ${depth(reach.low.at(-1))} mm deep; beyond it, only a plan shows whether a target can be reached.`, false]] : [];
  return [...planWords(store), ...words];
}

const depth = ([x]) => shown(x, 0);
