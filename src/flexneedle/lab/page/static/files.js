// Scenarios and runs: presets, files, recorded runs with downloads, pictures.

import { button, make } from "./dom.js";
import { savePicture } from "./files/download.js";
import { showRuns } from "./files/runs.js";
import { STEERING, allow, isCut, whyNot } from "./shown.js";

const LARGEST = 200_000; // characters of a scenario file
const MOST_WORLDS = 1e9;

export function mount(element, store, link) {
  const preset = make("select", { id: "files-preset", "aria-label": "Preset" });
  const begins = (name) => unlessChanged(store, status, `To begin with ${name}`, "Begin", () => link.ask({ type: "preset", name }));
  const begin = button("Begin", () => begins(preset.value), { "aria-label": "Begin with the preset" });
  const world = make("input", { type: "number", min: "0", step: "1", value: "100012", "aria-label": "Number of a random world" });
  const draw = button("Random world", () => beginWorld(world, begins));
  const file = make("input.spoken", { type: "file", accept: ".toml", "aria-label": "Scenario file", tabindex: "-1" });
  const load = button("Load a file…", () => file.click());
  const save = make("a", { href: "/scenario.toml", download: "scenario.toml" }, "Save the scenario");
  const status = make("span.quiet", { role: "status" });
  const picture = button("Picture", () => savePicture(store), { title: "The shown view of the scene as PNG" });
  const steered = make("fieldset.bare", {}, make("div.tools", {}, preset, begin), make("div.tools", {}, world, draw), make("div.tools", {}, load, file));
  const runs = make("fieldset.bare.runs");
  element.append(steered, make("div.tools", {}, save, picture, status), runs);

  file.addEventListener("change", () => loadFile(file, store, link, status));
  acceptDrops(element, store, link, status);
  store.subscribe(["welcome", "session"], () => choosePreset(preset, store));
  store.subscribe(STEERING, () => {
    allow(store, steered);
    Object.assign(runs, { disabled: isCut(store), title: isCut(store) ? whyNot(store) : "" });
  });
  showRuns(runs, store, link);
}

function choosePreset(select, store) {
  const names = store.get("welcome")?.presets ?? [];
  if (select.options.length !== names.length) {
    select.replaceChildren(...names.map((name) => make("option", {}, name)));
    delete select.dataset.session;
  }
  const { name } = store.get("session") ?? {};
  if (!names.includes(name) || name === select.dataset.session) return; // what the user has chosen stays
  select.value = select.dataset.session = name;
}

function beginWorld(input, begins) {
  const number = Number(input.value);
  if (!Number.isInteger(number) || number < 0 || number > MOST_WORLDS) input.setAttribute("aria-invalid", "true");
  else {
    input.removeAttribute("aria-invalid");
    begins(`wide:${number}`);
  }
}

async function loadFile(input, store, link, status) {
  const [file] = input.files;
  input.value = ""; // so that the same file can be loaded again
  if (file) await send(file, store, link, status);
}

async function send(file, store, link, status) {
  const text = await file.text();
  if (text.length > LARGEST) {
    status.textContent = `${file.name}: has ${text.length} characters, must have at most ${LARGEST}`;
    return;
  }
  const name = acceptable(file.name);
  await unlessChanged(store, status, `To load ${name}`, "Load", () => link.ask({ type: "load", name, text }));
}

function acceptDrops(element, store, link, status) {
  element.addEventListener("dragover", (event) => event.preventDefault());
  element.addEventListener("drop", (event) => {
    event.preventDefault();
    const [file] = event.dataTransfer.files;
    if (file) send(file, store, link, status);
  });
}

// A name that requests accept (requests.py: FileName).
const acceptable = (name) => name.replace(/[^A-Za-z0-9 ._-]/g, "_").replace(/^[^A-Za-z0-9]+/, "").slice(0, 80) || "scenario";

// Call `open`, which begins another scenario; if this one was changed, ask in `status` first. words: the action, as the
// beginning of a sentence; name: of the button.
function unlessChanged(store, status, words, name, open) {
  status.textContent = "";
  if (!store.get("session")?.changed.length) return open();
  const choice = (text, then) => button(text, () => {
    status.textContent = "";
    then();
  });
  const question = `${words} drops the changes that were made here.`;
  status.replaceChildren(question, " ", choice(name, open), " ", choice("Keep this scenario", () => {}));
  return undefined;
}
