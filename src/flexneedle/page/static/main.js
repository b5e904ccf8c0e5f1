// Loads the panels: each is a module with `export function mount(element, store, link)`, whose section of index.html
// is shown once it is listed here. space.js is last: it is the largest.

import { Link } from "./link.js";
import { Store } from "./store.js";
import { followTheme } from "./theme.js";

const PANELS = ["status", "form", "files", "insertion", "player", "section", "axial", "plans", "plots", "tour", "space"];

const store = new Store();
const link = new Link(store);
window.flexneedle = { store, link }; // for the console, and for tests
link.connect();
followTheme(store, document.getElementById("theme"));

async function load(name) {
  const element = document.querySelector(`[data-panel="${name}"]`);
  const section = element.closest("[hidden]");
  if (section) section.hidden = false;
  try {
    const panel = await import(`./${name}.js`);
    await panel.mount(element, store, link);
  } catch (error) {
    element.textContent = `This part of the page could not be loaded: ${error.message}`;
    throw error;
  }
}

for (const name of PANELS) load(name);
