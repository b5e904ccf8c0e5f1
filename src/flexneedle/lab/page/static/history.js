// Undo and redo of changes of the scenario and the options, by buttons and Ctrl+Z, Ctrl+Shift+Z.

import { button } from "./dom.js";
import { STEERING, allow, retracts, runs } from "./shown.js";

const TYPED = "input:not([type=checkbox], [type=radio], [type=range]), textarea, select, [contenteditable]";

export function mount(element, store, link) {
  const ask = (redo) => link.ask({ type: "undo", redo });
  const undo = button("Undo", () => ask(false), { title: "Undo the last change of the scenario (Ctrl+Z)" });
  const redo = button("Redo", () => ask(true), { title: "Redo the change that was undone (Ctrl+Shift+Z)" });
  element.append(undo, redo);
  store.subscribe(["session", ...STEERING, "insertion live", "rig"], () => {
    const session = store.get("session");
    const may = !runs(store.get("insertion live")) && !retracts(store);
    allow(store, undo, may && session?.undoes);
    allow(store, redo, may && session?.redoes);
  });
  document.addEventListener("keydown", (event) => {
    const again = stepOf(event);
    if (again === null) return;
    event.preventDefault();
    (again ? redo : undo).click(); // a disabled one does nothing
  });
}

// Return whether a key redoes (true) or undoes (false) a change; null: neither, or the key is typed in a field.
function stepOf({ key, ctrlKey, metaKey, altKey, shiftKey, target }) {
  if (key.toLowerCase() !== "z" || !(ctrlKey || metaKey) || altKey || target.closest?.(TYPED)) return null;
  return shiftKey;
}
