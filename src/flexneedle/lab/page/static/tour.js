// A short tour, shown once; a button in the header shows it again. It covers nothing that it speaks of.

import { button, make } from "./dom.js";
import { remember, remembered } from "./memory.js";

const SEEN = "flexneedle tour";
const STOPS = [
  [".space", "The scene, to scale: needle and guide on the left, tissue, and the target in green. Drag the arrows of the target, and a new estimate of the path follows."],
  [".section", "The same in section. Target, guide and boundaries of layers can be dragged here, or moved by the arrow keys."],
  [".plans", "“Plan” searches for a path: sampled paths narrow, and the cost falls. “Both strategies” plans with the guide (manipulation) and with the bevel alone (steering), and shows both side by side."],
  [".insertion", "“Insert” makes a plan and carries it out on the virtual rig, in real time. Disturb it, and see the controller react. Anyone can press “Stop”."],
  [".player", "Scrub through an insertion or a recorded run: all views and plots follow."],
  ["#settings", "Presets, files and recorded runs; and each value of the scenario, with its unit and bounds."],
];

export function mount(element) {
  const text = make("p", { id: "tour-text", "aria-live": "polite" });
  const count = make("span.quiet", { "aria-live": "polite" });
  const next = button("Next", () => show(at + 1), { class: "primary" });
  const skip = button("Skip", end);
  const card = make("div.tour", { role: "dialog", "aria-label": "Tour", "aria-describedby": "tour-text", hidden: true, tabindex: "-1" }, text, make("div.tools", {}, next, skip, count));
  const again = button("Tour", () => begin(), { "aria-haspopup": "dialog" });
  element.append(again, card);
  card.addEventListener("keydown", ({ key }) => key === "Escape" && end());
  let at = -1;
  let stops = [];
  if (!remembered(SEEN)) begin(false);

  function begin(focus = true) {
    stops = STOPS.filter(([place]) => document.querySelector(`${place}:not([hidden])`));
    card.hidden = false;
    show(0, focus);
    if (focus) next.focus();
  }

  function show(stop, scroll = true) {
    mark(false);
    at = stop;
    if (at >= stops.length) {
      end();
      return;
    }
    text.textContent = stops[at][1];
    count.textContent = `${at + 1} of ${stops.length}`;
    next.textContent = at + 1 < stops.length ? "Next" : "Done";
    skip.hidden = at + 1 === stops.length;
    mark(true);
    if (scroll) document.querySelector(stops[at][0]).scrollIntoView({ block: "start" });
  }

  function mark(on) {
    if (stops[at]) document.querySelector(stops[at][0]).classList.toggle("toured", on);
  }

  function end() {
    mark(false);
    at = -1;
    if (card.contains(document.activeElement)) again.focus({ preventScroll: true }); // a hidden card loses the focus
    card.hidden = true;
    remember(SEEN, "seen");
  }
}
