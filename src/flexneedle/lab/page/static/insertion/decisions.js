// Decisions of the controller in words: of the shown period, and a list of changes.

import { button, make, shown } from "../dom.js";
import { SHOWN, shownOf, shownPeriod, shownRow, startOf } from "../shown.js";

const MOST = 100; // entries: the newest
const NUMBER = /[-+−]?\d+(\.\d+)?(e[-+]\d+)?/g;

export function followDecisions(element, store) {
  const whose = make("p.quiet", { hidden: true });
  const now = make("p.now");
  const list = make("ol", { "aria-label": "Decisions" });
  element.append(whose, now, list);
  let made = { of: null, first: null, count: 0, words: "", buttons: [] };

  store.subscribe(SHOWN, () => {
    const of = shownOf(store);
    const rows = store.get(`rows ${of}`) ?? [];
    const row = shownRow(store, of);
    now.hidden = list.hidden = !row;
    whose.hidden = of !== "first" || !store.get("insertion live");
    whose.textContent = whose.hidden ? "" : `Decisions of ${store.get("insertion first").name}, which is shown:`;
    const start = startOf(store, of);
    now.textContent = row ? inWords(row, row.time - start) : "";
    if (made.of !== of || made.first !== rows[0] || rows.length < made.count) restart(of, rows[0]);
    for (let at = made.count; at < rows.length; at++) add(rows[at], rows[at].time - start);
    mark(shownPeriod(store, of));
  });

  function restart(of, first) {
    made = { of, first, count: 0, words: "", buttons: [] };
    list.replaceChildren();
  }

  // An entry for each change of the words; numbers alone change nearly every period.
  function add(row, time) {
    made.count = row.index + 1;
    const text = textOf(row);
    const words = text.replace(NUMBER, "#");
    if (words === made.words) return;
    made.words = words;
    const go = button(`${shown(time, 1)} s`, () => store.set("view period", row.index), { "aria-label": `Show period ${row.index + 1}` });
    const entry = make("li", {}, go, make("span", { class: row.warning || row.late ? "bad" : "" }, text));
    list.prepend(entry);
    made.buttons.push({ index: row.index, entry });
    if (made.buttons.length > MOST) made.buttons.shift().entry.remove();
  }

  // The entry that holds at the shown period.
  function mark(period) {
    const current = made.buttons.findLast(({ index }) => period !== null && index <= period);
    for (const { entry } of made.buttons) {
      if (entry === current?.entry) entry.setAttribute("aria-current", "step");
      else if (entry.hasAttribute("aria-current")) entry.removeAttribute("aria-current");
    }
  }
}

function textOf({ decision, verdict, warning, late, decide_ms: decided }) {
  const parts = [decision];
  if (verdict && verdict !== "ok" && !decision.includes(verdict)) parts.push(`measurement ${verdict}`);
  if (late) parts.push(`decided late, after ${shown(decided, 0)} ms`);
  if (warning) parts.push(warning);
  return parts.join("; ");
}

function inWords(row, time) {
  const miss = row.miss_mm.filter((each) => each !== null);
  const predicted = miss.length ? `, predicted miss ${shown(Math.hypot(...miss))} mm, standard deviation ${shown(row.miss_sd_mm)} mm` : "";
  const error = `error from the planned path ${shown(row.error_mm)} mm`;
  return `Period ${row.index + 1}, ${shown(time, 1)} s: ${textOf(row)} (${error}${predicted}).`;
}
