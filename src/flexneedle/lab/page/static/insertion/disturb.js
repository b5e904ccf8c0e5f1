// Disturb a virtual insertion: push the tip, stiffen a layer, drop the tracker, bring a metal plate.

import { button, make } from "../dom.js";

const NO_FIELD = "The tracker of this scenario has no field that metal distorts. Set its environment to ideal.";

// A form whose requests act at once, with a list of active disturbances.
export function disturbForm(store, link) {
  const active = make("p.quiet", { role: "status" });
  const number = (label, value, more = {}) => make("input", { type: "number", min: "0", max: "10000", step: "any", required: true, value: String(value), "aria-label": label, ...more });
  const [force, angle] = [number("Force on the tip in N", 0.02), number("Direction of the force in degrees", 0, { min: "-360", max: "360", title: "From y to z" })];
  const [layer, factor] = [make("select", { "aria-label": "Layer" }), number("Factor on its stiffness", 2)];
  const seconds = number("Seconds without the tracker", 1);
  const disturb = (what, size, more = {}) => {
    if (size.reportValidity()) link.ask({ type: "disturb", what, size: size.valueAsNumber, ...more });
  };
  const none = (what) => link.ask({ type: "disturb", what, size: 0 });

  const plate = [
    number("Distance of the plate from the center of the tracker's workspace in mm", 100),
    button("Bring", () => disturb("plate", plate[0])),
    button("Remove the plate", () => none("plate")),
  ];
  const why = make("span.quiet", {}, NO_FIELD);

  const form = make(
    "fieldset.disturb", { hidden: true }, make("legend", {}, "Disturb the insertion"),
    line("Push the tip", pair(force, "N"), pair("at", angle, "°"), button("Push", () => angle.reportValidity() && disturb("push", force, { angle_deg: angle.valueAsNumber })), button("Let go", () => none("push"), { "aria-label": "Let go of the tip" })),
    line(layer, pair("×", factor), button("Stiffen", () => disturb("stiffen", factor, { layer: Number(layer.value) }))),
    line("Drop the tracker for", pair(seconds, "s"), button("Drop", () => disturb("drop", seconds))),
    line("Metal plate at", pair(plate[0], "mm"), make("span.quiet", {}, "from the center of the tracker's workspace"), plate[1], plate[2], why),
    active,
  );
  store.subscribe(["disturbances"], () => {
    const list = store.get("disturbances")?.active ?? [];
    active.textContent = list.length ? `Active: ${list.join("; ")}` : "";
  });
  store.subscribe(["session"], () => {
    const field = hasField(store.get("session"));
    for (const each of plate) each.disabled = !field;
    why.hidden = field;
  });
  store.subscribe(["insertion live", "scene"], () => chooseLayers(layer, store));
  return form;
}

const line = (...parts) => make("div.tools", {}, ...parts);
const pair = (...parts) => make("span.pair", {}, ...parts); // not broken

const hasField = (session) => Object.keys(session?.values ?? {}).some((key) => key.startsWith("tracker.environment."));

function chooseLayers(select, store) {
  const layers = (store.get("insertion live")?.scene ?? store.get("scene"))?.layers ?? [];
  const names = layers.map(({ name }, index) => `${index + 1}: ${name}`);
  if (names.join() === [...select.options].map(({ text }) => text).join()) return;
  select.replaceChildren(...names.map((name, index) => make("option", { value: String(index) }, name)));
}
