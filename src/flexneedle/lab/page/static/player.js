// Time: the insertion and the period that all views show; scrub, play, slower, faster.
// Keys within the panel: space plays, , and . step, Home and End, < and > change the speed.

import { button, make, shown } from "./dom.js";
import { SHOWN, shownOf, shownPeriod, startOf } from "./shown.js";
import { TARGET_AND_PLAN } from "./still.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10, 20];
const NAMES = { scene: TARGET_AND_PLAN, live: "Insertion", first: "Recorded run" };

export function mount(element, store) {
  const player = new Player(store);
  const choices = Object.entries(NAMES).map(([of, text]) => button(text, () => player.choose(of), { "data-of": of }));
  const play = button("Play", () => player.toggle(), { "aria-keyshortcuts": "Space" });
  const back = button("‹", () => player.step(-1), { "aria-label": "Previous period", "aria-keyshortcuts": "," });
  const on = button("›", () => player.step(1), { "aria-label": "Next period", "aria-keyshortcuts": "." });
  const speed = make("select", { "aria-label": "Speed", "aria-keyshortcuts": "< >", change: () => store.set("view speed", speed.selectedIndex) });
  speed.append(...SPEEDS.map((each) => make("option", {}, `${each}×`)));
  const newest = button("Latest period", () => player.follow(), { title: "Show the latest period, and each new one" });
  const place = make("span.number.quiet");
  const scrub = make("input", { type: "range", min: "0", step: "1", "aria-label": "Period", input: () => player.show(Number(scrub.value)) });
  const tools = make("div.tools", { role: "toolbar", "aria-label": "Player" }, play, back, on, speed, newest);
  const nothing = make("p.quiet", {}, "No insertion and no recorded run yet.");
  const group = make("div.tools", { role: "group", "aria-label": "Shown insertion" }, ...choices);
  element.append(group, tools, scrub, place, nothing);
  element.addEventListener("keydown", (event) => player.key(event));

  store.subscribe([...SHOWN, "view playing", "view speed"], () => {
    const of = shownOf(store);
    const rows = store.get(`rows ${of}`) ?? [];
    const period = shownPeriod(store, of);
    for (const each of choices) {
      each.setAttribute("aria-pressed", String(each.dataset.of === of));
      each.hidden = each.dataset.of !== "scene" && !store.get(`insertion ${each.dataset.of}`);
    }
    group.hidden = choices.filter(({ hidden }) => !hidden).length < 2 || !store.get("scene"); // a replay has only its run
    const some = period !== null;
    scrub.hidden = tools.hidden = place.hidden = !some;
    nothing.hidden = some || Boolean(store.get("insertion live") ?? store.get("insertion first"));
    if (!some) return;
    scrub.max = String(rows.length - 1);
    scrub.value = String(period);
    const time = `${shown(rows[period].time - startOf(store, of), 1)} s`;
    scrub.setAttribute("aria-valuetext", `period ${period + 1} of ${rows.length}, ${time}`);
    place.textContent = `${time} · period ${period + 1} of ${rows.length}`;
    play.textContent = store.get("view playing") ? "Pause playback" : "Play";
    speed.selectedIndex = SPEEDS.indexOf(player.speed);
    newest.disabled = store.get("view period") === undefined; // not hidden: the scrub would move under the finger
  });
}

class Player {
  #store;
  #frame = 0;
  #time = 0; // s of the insertion
  #period = 0; // last shown
  #before = 0; // ms of the last paint

  constructor(store) {
    this.#store = store;
  }

  get speed() {
    return SPEEDS[this.#store.get("view speed") ?? SPEEDS.indexOf(1)];
  }

  get #rows() {
    return this.#store.get(`rows ${shownOf(this.#store)}`) ?? [];
  }

  choose(of) {
    this.#pause();
    this.#store.set("view of", of);
    this.#store.set("view period", undefined);
  }

  // Show a period, and end playing.
  show(period) {
    this.#pause();
    this.#store.set("view period", Math.min(Math.max(period, 0), this.#rows.length - 1));
  }

  // Show the newest period as it comes.
  follow() {
    this.#pause();
    this.#store.set("view period", undefined);
  }

  step(by) {
    this.show((shownPeriod(this.#store) ?? 0) + by);
  }

  // Change the speed by one place.
  change(by) {
    const at = SPEEDS.indexOf(this.speed) + by;
    this.#store.set("view speed", Math.min(Math.max(at, 0), SPEEDS.length - 1));
  }

  toggle() {
    if (this.#store.get("view playing")) this.#pause();
    else this.#play();
  }

  key(event) {
    const { key, target } = event;
    const acts = { " ": () => this.toggle(), ",": () => this.step(-1), ".": () => this.step(1), "<": () => this.change(-1), ">": () => this.change(1) };
    if (event.ctrlKey || event.metaKey || event.altKey || !acts[key] || (key === " " && target.tagName === "BUTTON")) return;
    event.preventDefault();
    acts[key]();
  }

  // From the shown period, or from the start at the end.
  #play() {
    const rows = this.#rows;
    if (!rows.length) return;
    const at = shownPeriod(this.#store);
    const start = at >= rows.length - 1 ? 0 : at;
    this.#time = rows[start].time;
    this.#period = start;
    this.#store.set("view period", start);
    this.#store.set("view playing", true);
    this.#before = performance.now();
    this.#frame = requestAnimationFrame((now) => this.#tick(now));
  }

  #pause() {
    cancelAnimationFrame(this.#frame);
    this.#store.set("view playing", undefined);
  }

  // End playing at the end, and when another period is chosen, such as by a click on a plot.
  #tick(now) {
    if (this.#store.get("view period") !== this.#period) {
      this.#pause();
      return;
    }
    this.#time += (this.speed * Math.max(now - this.#before, 0)) / 1000;
    this.#before = now;
    const rows = this.#rows;
    while (this.#period < rows.length - 1 && rows[this.#period + 1].time <= this.#time) this.#period += 1;
    this.#store.set("view period", this.#period);
    if (this.#period >= rows.length - 1) this.#pause();
    else this.#frame = requestAnimationFrame((next) => this.#tick(next));
  }
}
