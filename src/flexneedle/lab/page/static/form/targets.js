// Named targets: one is the scenario's; others are added, chosen and removed.

import { button, make, shown } from "../dom.js";

export function followTargets(element, store, link) {
  const list = make("ul", { "aria-label": "Targets" });
  const name = make("input", { type: "text", maxlength: "40", placeholder: "Name", "aria-label": "Name of the target to add", size: "12" });
  const form = make("form.tools", {}, name, make("button", { type: "submit", title: "Another target, at the place of the present one" }, "Add a target"));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const written = name.value;
    const given = written.trim();
    const { done } = await link.ask({ type: "targets", what: "add", ...(given && { name: given }) });
    if (done && name.value === written) name.value = ""; // not what was written since
  });
  element.append(list, form);
  let made = "";
  const again = () => {
    made = "";
    show();
  };
  store.subscribe(["session", "draft"], show);

  function show() {
    const { targets = [], target } = store.get("session") ?? {};
    const key = JSON.stringify([targets, target]);
    if (key === made) return;
    made = key;
    const focused = list.contains(document.activeElement) && document.activeElement.value; // the radio button of a target
    list.replaceChildren(...targets.map((each) => entryOf(each, each.name === target, link, again)));
    if (focused) [...list.querySelectorAll("input")].find(({ value }) => value === focused)?.focus({ preventScroll: true });
  }
}

function entryOf({ name, position }, active, link, refused) {
  const ask = (what) => link.ask({ type: "targets", what, name });
  const radio = make("input", { type: "radio", name: "target", value: name, checked: active });
  radio.addEventListener("change", async () => {
    if (!(await ask("choose")).done) refused(); // the server has kept the other
  });
  const where = make("span.quiet.number", {}, position.map((value) => shown(value, 1)).join(", "));
  const remove = button("Remove", () => ask("remove"), { "aria-label": `Remove ${name}` });
  remove.disabled = active;
  return make("li.tools", {}, make("label.tools", {}, radio, name), where, remove);
}
