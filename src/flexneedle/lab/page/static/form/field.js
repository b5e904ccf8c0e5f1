// A field of the form: label, value with its unit, slider, description, and the problem of its value.

import { make } from "../dom.js";
import { rangeOf, read, written } from "./fields.js";

const WORDS = 24; // a field of text is at most this wide

export class FieldView {
  #field;
  #slider = null;
  #problem = make("p.problem.bad", { hidden: true });
  #shown; // value of the scenario, or of the draft
  #taken = false; // whether the text is the user's, and pending or refused
  #open; // shown problem
  #own; // problem of the text, which was not sent
  #dismissed; // problem that was left with Escape
  #before = ""; // text when the field got the focus

  // field: of fields.js; value: at first, which the slider's range depends on; edit: called with a new value, and whether the change
  // is complete; rest: called when a slider is released.
  constructor(field, value, edit, rest) {
    this.#field = field;
    [this.edit, this.rest] = [edit, rest];
    const id = `field-${field.key.replaceAll(".", "-")}`;
    this.#problem.id = `${id}-problem`;
    const help = make("p.help.quiet", { id: `${id}-help` }, field.description);
    this.input = this.#inputOf(id);
    const unit = field.unit && make("span.unit.quiet", { "aria-hidden": "true" }, field.unit);
    const name = make("label", { for: id, title: field.key }, field.label);
    if (field.unit) name.append(make("span.spoken", {}, ` in ${field.unit}`));
    const range = rangeOf(field, value);
    if (range) this.#slider = this.#sliderOf(range);
    this.element = make("div.field", { "data-key": field.key }, name, make("span.value", {}, this.input, unit));
    this.element.append(...[this.#problem, this.#slider, help].filter(Boolean));
  }

  // Text for the search.
  get words() {
    const { key, label, unit, description } = this.#field;
    return `${key} ${label} ${unit} ${description}`.toLowerCase();
  }

  // Show a value. state: {changed: differs from the file's, problem: of the server, pending: not answered yet}. Text
  // that is being written, or was refused, stays.
  update(value, { changed, problem, pending }) {
    if (problem !== this.#dismissed) this.#dismissed = undefined;
    const open = this.#own ?? (this.#dismissed ? undefined : problem);
    this.#shown = value;
    this.#show(open);
    this.element.classList.toggle("changed", changed && !open);
    if (!problem && !pending && !this.#own) this.#taken = false;
    if (open && this.#taken) return;
    if (this.#field.kind === "switch") this.input.checked = Boolean(value);
    else if (this.#field.kind === "choice" || document.activeElement !== this.input) this.input.value = written(value);
    if (this.#slider && document.activeElement !== this.#slider) this.#slider.value = value ?? this.#field.usual ?? 0;
  }

  #show(problem) {
    this.#problem.hidden = !problem;
    this.#open = problem;
    this.#problem.textContent = problem ?? "";
    this.element.classList.toggle("refused", Boolean(problem));
    this.input.setAttribute("aria-invalid", problem ? "true" : "false");
  }

  #inputOf(id) {
    const { kind, choices, nullable, usual } = this.#field;
    const described = { id, "aria-describedby": `${id}-problem ${id}-help` };
    if (kind === "switch") {
      return make("input", { ...described, type: "checkbox", change: ({ target }) => this.edit(target.checked) });
    }
    const change = () => this.#take();
    if (kind === "choice") {
      const names = nullable ? ["", ...choices] : choices;
      const options = names.map((name) => make("option", { value: name }, name || "not set"));
      return make("select", { ...described, change }, ...options);
    }
    const numeric = kind === "number" || kind === "integer";
    const given = { type: "text", inputmode: numeric ? "decimal" : undefined, placeholder: written(usual) || "not set" };
    const input = make("input", { ...described, ...given, autocomplete: "off", size: numeric ? "8" : String(WORDS), change });
    input.addEventListener("keydown", (event) => this.#key(event));
    input.addEventListener("focus", () => {
      this.#before = input.value;
    });
    input.addEventListener("blur", () => this.#leave());
    return input;
  }

  #sliderOf({ min, max, step }) {
    const { label, unit } = this.#field;
    const slider = make("input", { type: "range", min: `${min}`, max: `${max}`, step: `${step}`, "aria-label": `${label} ${unit}, slider` });
    slider.addEventListener("input", () => {
      const value = Number(slider.value);
      this.input.value = written(value);
      this.#taken = true;
      this.edit(value, false);
    });
    slider.addEventListener("change", () => this.rest());
    return slider;
  }

  #take() {
    const { value, problem } = read(this.#field, this.input.value);
    this.#taken = true;
    this.#own = problem;
    this.#show(problem);
    if (problem === undefined) this.edit(value);
  }

  // Show a value that arrived while the field had the focus, unless the user wrote something.
  #leave() {
    const refused = this.input.getAttribute("aria-invalid") === "true";
    if (!refused && this.input.value === this.#before) this.input.value = written(this.#shown);
  }

  // Escape restores the scenario's value; Enter is a change.
  #key({ key }) {
    if (key !== "Escape") return;
    this.#taken = false;
    this.#own = undefined;
    this.#dismissed = this.#open || undefined;
    this.input.value = written(this.#shown);
    this.#show(undefined);
  }
}
