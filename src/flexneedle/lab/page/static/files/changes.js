// Confirmation before the changes of a scenario are lost.

import { button } from "../dom.js";

// Call `open`, which begins another scenario; if this one was changed, ask in `status` first. words: the action, as the
// beginning of a sentence; name: of the button.
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
