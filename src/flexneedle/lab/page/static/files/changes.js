// A question before the changes of a scenario are lost.

import { button } from "../dom.js";

// Do `open`, which begins another scenario, or where this one was changed ask for it in `status` before. words: what is to
// be done, as the beginning of a sentence; name: of the button that does it.
export function unlessChanged(store, status, words, name, open) {
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
