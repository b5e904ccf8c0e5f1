// A recorded run without a server (page/replay.py): the panels that need no server; the run is an element of the document.

import { mount as mountAxial } from "./axial.js";
import { make } from "./dom.js";
import { unpacked } from "./frames.js";
import { followDecisions } from "./insertion/decisions.js";
import { followSensors } from "./insertion/sensors.js";
import { inWords } from "./insertion/words.js";
import { layOut } from "./layout.js";
import { loadTable } from "./load.js";
import { mount as mountPlayer } from "./player.js";
import { mount as mountPlots } from "./plots.js";
import { mount as mountSection } from "./section.js";
import { mount as mountSpace } from "./space.js";
import { Store } from "./store.js";
import { followTheme } from "./theme.js";

// In the order of main.js. Without a server there are no requests: the panels get no link.
const PANELS = { insertion: mountWords, player: mountPlayer, section: mountSection, axial: mountAxial, plots: mountPlots, space: mountSpace };
const RUNS = { first: "", second: "Compared with " };

const store = new Store();
window.flexneedle = { store }; // for the console, and for tests
followTheme(store, document.getElementById("theme"));
for (const each of JSON.parse(document.getElementById("run").textContent)) {
  if (typeof each === "string") store.receiveFrame(unpacked(bytesOf(each)));
  else store.receive(each);
}
layOut(store, ["player"], ["insertion", "plots"]);
for (const [name, mount] of Object.entries(PANELS)) load(mount, document.querySelector(`[data-panel="${name}"]`));

// The ArrayBuffer of a text in base64.
function bytesOf(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
}

async function load(mount, element) {
  try {
    await mount(element, store, null);
  } catch (error) {
    element.textContent = `This part of the replay could not be shown: ${error.message}`;
    throw error;
  }
}

function mountWords(element) {
  for (const [of, what] of Object.entries(RUNS)) {
    const run = store.get(`insertion ${of}`);
    if (run) element.append(make("p", {}, make("strong", {}, `${what}${run.name}.`), ` ${inWords(run)}`));
  }
  const [sensors, decisions] = [make("div"), make("div.decisions")];
  element.append(...loadTable(Object.keys(RUNS).map((of) => store.get(`insertion ${of}`))), sensors, decisions);
  followSensors(sensors, store);
  followDecisions(decisions, store);
}
