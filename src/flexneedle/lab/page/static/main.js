// Loads the panels: each is a module with `export function mount(element, store, link)`, and has a place (layout.js).
// The scene comes first, and in it space.js, the largest, last; the rest when the scene is drawn.

import { layOut } from "./layout.js";
import { Link } from "./link.js";
import { Store } from "./store.js";
import { followTheme } from "./theme.js";

const SCENE = ["status", "actions", "section", "axial", "space"];
const OTHERS = ["history", "form", "insertion", "player", "plans", "plots", "files", "rig"];
const PATIENCE = 2000; // ms
const FRAMES = 3; // until the mounted panels are on the screen

const store = new Store();
layOut(store, ["player", "actions"], ["form", "plans", "insertion", "plots", "files", "rig"]);
const link = new Link(store);
window.flexneedle = { store, link }; // for the console, and for tests
link.connect();
followTheme(store, document.getElementById("theme"));

async function load(name) {
  const element = document.querySelector(`[data-panel="${name}"]`);
  try {
    const panel = await import(`./${name}.js`);
    await panel.mount(element, store, link);
  } catch (error) {
    element.textContent = `This part of the page could not be loaded: ${error.message}`;
    reportError(error); // and the other parts are loaded
  }
}

const late = new Promise((resolve) => setTimeout(resolve, PATIENCE)); // such as three.js on a slow line
await Promise.race([Promise.all(SCENE.map(load)), late]);
for (let frame = 0; frame < FRAMES; frame++) await new Promise(requestAnimationFrame);
for (const name of OTHERS) load(name);
