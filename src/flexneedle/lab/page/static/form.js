// The scenario by fields: options, then the sections of the schema, opened one by one or found by a search.

import { button, make } from "./dom.js";
import { FieldView } from "./form/field.js";
import { editOf, sectionsOf, shownOf, valueOf, withLaw } from "./form/fields.js";
import { followOptions } from "./form/options.js";
import { followTargets } from "./form/targets.js";
import { STEERING, allow } from "./shown.js";

const ORDER = ["target", "needle", "needle.bevel", "tissue", "zones", "zone", "setup", "entry", "plan", "control", "tracker", "phantom"];
const LAW = /^(tissue\.\d+)\.law$/;
const OPEN = ["target", "needle.bevel"];

export async function mount(element, store, link) {
  const options = make("div.options");
  const doubts = make("ul.doubts.bad", { "aria-label": "Implausible values", hidden: true });
  const search = make("input", { type: "search", placeholder: "Search: modulus, weight, seed …", "aria-label": "Search the settings" });
  const none = make("p.quiet", { role: "status" });
  const sections = make("div.sections");
  const targets = make("div.targets");
  const fields = make("fieldset.bare", {}, targets, options, doubts, make("div.tools", {}, search), none, sections);
  element.append(fields);
  followTargets(targets, store, link);
  const findOptions = followOptions(options, store, link);

  const answer = await fetch("/schema.json");
  if (!answer.ok) throw new Error(`the schema of scenarios: ${answer.status} ${answer.statusText}`);
  const form = new Form(sections, await answer.json(), store, link);
  const find = () => {
    const words = search.value.trim().toLowerCase().split(/\s+/).filter(Boolean);
    const count = findOptions(words) + form.find(words);
    none.textContent = words.length ? `${count} ${count === 1 ? "setting" : "settings"}` : "";
  };
  search.addEventListener("input", find);
  store.subscribe(["session", "draft", "refusals"], () => {
    if (form.update()) find();
    showDoubts(doubts, store.get("session")?.doubts ?? []);
  });
  store.subscribe(STEERING, () => allow(store, fields));
}

function showDoubts(element, doubts) {
  element.hidden = !doubts.length;
  element.replaceChildren(...doubts.map((doubt) => make("li", {}, doubt)));
}

class Form {
  #element;
  #schema;
  #store;
  #link;
  #made = ""; // name, keys and layers of the form
  #sections = [];
  #session = null; // the last one: between two connections the store has none
  #problems = {}; // by key
  #refusal = 0; // number of the newest refusal
  #revision;
  #chosen = ""; // key of the last edited field

  constructor(element, schema, store, link) {
    [this.#element, this.#schema, this.#store, this.#link] = [element, schema, store, link];
  }

  // Show the session with the draft. Return whether the fields have changed.
  update() {
    const session = this.#store.get("session");
    if (!session) return false;
    this.#session = session;
    const remade = this.#remake(session);
    this.#readProblems(session);
    for (const section of this.#sections) this.#fill(section);
    return remade;
  }

  // Show the fields that contain all words, and their sections; without words all. Return their number.
  find(words) {
    let count = 0;
    for (const section of this.#sections) {
      if (words.length) this.#make(section);
      for (const { element, words: its } of section.views) {
        element.hidden = !words.every((word) => `${section.title.toLowerCase()} ${its}`.includes(word));
        count += !element.hidden;
      }
      section.element.hidden = words.length > 0 && section.views.every((view) => view.element.hidden);
      if (words.length) section.element.open = !section.element.hidden;
    }
    return count;
  }

  // Make the form again for another scenario, and for other layers or tables.
  #remake({ name, values }) {
    const words = Object.keys(values).filter((key) => /^(tissue|zone)\.\d+\.(law|name|shape)$/.test(key)).map((key) => values[key]);
    const made = JSON.stringify([name, Object.keys(values), words]);
    if (made === this.#made) return false;
    const open = this.#sections.filter(({ element }) => element.open).map((section) => section.name);
    const focused = this.#element.contains(document.activeElement) && document.activeElement.id;
    this.#made = made;
    const found = sectionsOf(this.#schema, values).sort((a, b) => place(a.name) - place(b.name));
    if (this.#sections.length) open.push(this.#chosen); // a table chosen just now
    this.#sections = found.map((section) => this.#sectionOf(section, open));
    this.#element.replaceChildren(...this.#sections.map((section) => section.element));
    if (focused) document.getElementById(focused)?.focus({ preventScroll: true });
    return true;
  }

  #sectionOf(section, open) {
    const summary = make("summary", {}, section.title);
    const element = make("details", { "data-section": section.name }, summary);
    const made = { ...section, element, views: [] };
    element.addEventListener("toggle", () => {
      this.#make(made);
      this.#fill(made);
    });
    element.open = open.length ? open.includes(section.name) : OPEN.includes(section.name);
    if (element.open) this.#make(made);
    return made;
  }

  // Make the fields of a section when it is first opened.
  #make(section) {
    if (section.views.length) return;
    const { values } = this.#session;
    section.views = section.fields.map((field) => {
      const edit = (value, complete = true) => this.#edit(field, value, complete);
      return Object.assign(new FieldView(field, valueOf(field, values), edit, () => this.#link.rest()), { key: field.key, field });
    });
    if (section.description) section.element.append(make("p.quiet", {}, section.description));
    section.element.append(...section.views.map((view) => view.element));
    if (section.name.startsWith("tissue.")) section.element.append(this.#layerTools(section.name));
    if (section.name === "zones") section.element.append(this.#newZoneTools());
    if (section.name.startsWith("zone.")) section.element.append(this.#zoneTools(section.name));
    this.#fill(section);
  }

  // The problem of a field, or of a part of its value without a field; for a law also of a part of its layer.
  #problemOf(field) {
    const { [field.key]: own, ...others } = this.#problems;
    const whole = field.key.replace(LAW, "$1") + ".";
    const part = Object.keys(others).find((key) => key.startsWith(whole) && !this.#fields.has(key));
    return own ?? (part && `${part.slice(whole.length)}: ${others[part]}`);
  }

  get #fields() {
    return new Set(this.#sections.flatMap(({ fields }) => fields.map(({ key }) => key)));
  }

  #edit(field, value, complete) {
    this.#chosen = field.key;
    this.#link.edit(this.#editOf(field, value));
    if (complete) this.#link.rest();
  }

  #editOf(field, value) {
    const [, name] = LAW.exec(field.key) ?? [];
    const { values } = this.#session;
    if (!name) return editOf(field, value, values);
    const [layers, layer] = [tablesOf(values, "tissue"), Number(name.split(".")[1])];
    return { tissue: layers.with(layer, withLaw(this.#schema, layers[layer], value)) };
  }

  #fill(section) {
    const [{ values, changed }, draft] = [this.#session, this.#store.get("draft") ?? {}];
    for (const view of section.views) {
      const edited = editedOf(view.field, draft);
      const pending = edited !== undefined;
      const value = pending ? edited : valueOf(view.field, values);
      const isChanged = changed.some((key) => isOf(view.field, key));
      view.update(value, { changed: isChanged, problem: this.#problemOf(view.field), pending });
    }
    const faulty = section.fields.some((field) => this.#problemOf(field));
    section.element.classList.toggle("faulty", faulty);
  }

  // Problems of the newest refusal, until an edit is taken; the section of the first is opened.
  #readProblems({ revision }) {
    if (revision !== this.#revision) this.#problems = {};
    this.#revision = revision;
    const newest = (this.#store.get("refusals") ?? []).at(-1);
    if (!newest || newest.number === this.#refusal) return;
    this.#refusal = newest.number;
    this.#problems = newest.problems;
    const keys = Object.keys(newest.problems);
    const first = this.#sections.find(({ fields }) => fields.some((field) => keys.includes(field.key) || this.#problemOf(field)));
    if (!first) return;
    first.element.open = true;
    this.#fill(first);
    first.views.find(({ element }) => element.matches(".refused"))?.element.scrollIntoView({ block: "center" });
  }

  // Edit all tables of an array of the scenario.
  #change(array, make) {
    this.#link.edit({ [array]: make(tablesOf(this.#session.values, array)) });
    this.#link.rest();
  }

  #newZoneTools() {
    const add = (shape) => this.#change("zone", (zones) => [...zones, { shape, name: `${shape} ${zones.length + 1}`, ...newZone(shape, this.#store.get("scene").target) }]);
    const choices = ["sphere", "capsule", "box", "half-space"].map((shape) => button(`Add a ${shape}`, () => add(shape)));
    return make("div.tools", {}, ...choices);
  }

  #zoneTools(name) {
    const zone = Number(name.split(".")[1]);
    return make("div.tools", {}, button("Remove", () => this.#change("zone", (zones) => zones.toSpliced(zone, 1)), { "aria-label": `Remove zone ${zone + 1}` }));
  }

  #layerTools(name) {
    const layer = Number(name.split(".")[1]);
    const change = (make) => this.#change("tissue", make);
    const add = () => change((layers) => layers.toSpliced(layer, 0, { ...layers[layer], thickness_mm: layers[layer].thickness_mm ?? 10 }));
    const remove = button("Remove", () => change((layers) => layers.toSpliced(layer, 1)), { "aria-label": `Remove layer ${layer + 1}` });
    remove.disabled = !("tissue.1.shear_modulus_kpa" in this.#session.values);
    return make("div.tools", {}, button("Add a layer above", add, { "aria-label": `Add a layer above layer ${layer + 1}` }), remove);
  }
}

// Pending value of a field; undefined without a pending edit.
function editedOf(field, draft) {
  const [, name] = LAW.exec(field.key) ?? [];
  if (name && draft.tissue) return draft.tissue[Number(name.split(".")[1])]?.law;
  return field.key in draft ? shownOf(field, draft[field.key]) : undefined;
}

// Return whether a key belongs to a field or its table.
const isOf = (field, key) => key === field.key || (field.start && key.startsWith(`${field.key}.`));

// Tables of an array of the scenario, such as "tissue", from values by key.
function tablesOf(values, array) {
  const tables = [];
  for (const [key, value] of Object.entries(values)) {
    const [name, table, ...part] = key.split(".");
    if (name === array && part.length) (tables[table] ??= {})[part.join(".")] = value;
  }
  return tables;
}

// Values of a new zone: beside the way to the target, or beyond it.
function newZone(shape, [depth, y, z]) {
  const [beside, beyond] = [[0.5 * depth, y + 8, z], [depth + 10, 0, 0]];
  return {
    sphere: { center_mm: beside, radius_mm: 3 },
    capsule: { from_mm: [beside[0], beside[1], z - 10], to_mm: [beside[0], beside[1], z + 10], radius_mm: 2 },
    box: { center_mm: beside, size_mm: [4, 4, 4] },
    "half-space": { point_mm: beyond, normal: [-1, 0, 0] },
  }[shape];
}

function place(name) {
  const at = ORDER.indexOf(/^(tissue|zone)\./.test(name) ? name.split(".")[0] : name);
  return at < 0 ? ORDER.length : at;
}
