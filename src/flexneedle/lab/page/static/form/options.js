// Options outside the scenario: seed, strategy, controller.

import { button, make } from "../dom.js";

const MOST = 2 ** 53;

// Fields of the options in `element`, which follow the session. Return a function that shows the options that
// contain all given words, and returns their number.
export function followOptions(element, store, link) {
  const ask = async (options) => {
    const answer = await link.ask({ type: "options", ...options });
    if (!answer.done) show();
  };
  let known = null; // last shown seed
  let pending = null; // seed that is not answered
  const seed = make("input", {
    id: "option-seed", type: "number", min: "0", step: "1", inputmode: "numeric", change: () => takeSeed(seed.value.trim() === "" ? NaN : Number(seed.value)),
  });
  const problem = make("p.problem.bad", { id: "option-seed-problem", role: "alert", hidden: true });
  const takeSeed = (value) => {
    const valid = Number.isInteger(value) && value >= 0 && value <= MOST;
    mark(valid ? "" : `must be a whole number from 0 to ${MOST}; the seed is still ${known}`);
    if (valid) askSeed(value);
  };
  async function askSeed(value) {
    pending = value;
    await ask({ seed: value });
    if (pending === value) pending = null;
  }
  function mark(text) {
    problem.textContent = text;
    problem.hidden = !text;
    seed.setAttribute("aria-invalid", String(Boolean(text)));
    seed.setAttribute("aria-describedby", problem.id);
  }
  const next = button("Next", () => takeSeed((pending ?? store.get("session").seed) + 1), { "aria-label": "Next seed" });
  const strategy = make("select", { id: "option-strategy", change: () => ask({ strategy: strategy.value }) });
  const controller = make("select", { id: "option-controller", change: () => ask({ controller: controller.value }) });
  const help = make("p.help.quiet", { id: "option-help" });
  controller.setAttribute("aria-describedby", "option-help");
  const fields = [
    [row("Seed", seed, next), problem], [row("Strategy", strategy)], [row("Controller", controller), help],
  ].map((parts) => make("div.option", {}, ...parts));
  element.append(...fields);

  function show() {
    const [session, welcome] = [store.get("session"), store.get("welcome")];
    if (!session || !welcome) return;
    if (session.seed !== known) mark("");
    if (session.seed !== known || (document.activeElement !== seed && problem.hidden)) seed.value = session.seed;
    known = session.seed;
    choose(strategy, welcome.strategies, session.strategy);
    choose(controller, welcome.controllers.map(({ name }) => name), session.controller);
    help.textContent = welcome.controllers.find(({ name }) => name === session.controller)?.summary ?? "";
  }
  store.subscribe(["session", "welcome"], show);

  return (words) => {
    for (const field of fields) field.hidden = !words.every((word) => field.textContent.toLowerCase().includes(word));
    return fields.filter(({ hidden }) => !hidden).length;
  };
}

const row = (name, input, ...more) =>
  make("div.field", {}, make("label", { for: input.id }, name), make("span.value", {}, input, ...more));

function choose(select, names, chosen) {
  if (select.options.length !== names.length) select.replaceChildren(...names.map((name) => make("option", {}, name)));
  select.value = chosen;
}
