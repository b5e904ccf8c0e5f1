// Tabs: one is shown, by store key "view tab". The row of tabs is one stop of the Tab key; arrow keys choose.

import { make } from "./dom.js";

const STEPS = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };

// tabs: [name, title, panel]. The tab "rig" is there while a rig is connected.
export function addTabs(element, store, tabs) {
  const entries = tabs.map(([name, title, panel]) => {
    Object.assign(panel, { id: `tab-${name}`, hidden: true });
    panel.setAttribute("role", "tabpanel");
    const tab = make("button", { type: "button", role: "tab", "data-tab": name, "aria-controls": panel.id, click: () => choose(name) }, title);
    return { name, tab, panel };
  });
  const choose = (name) => store.set("view tab", name);
  const list = make("div.tabs", { role: "tablist", "aria-label": "Tabs" }, ...entries.map(({ tab }) => tab));
  list.addEventListener("keydown", (event) => {
    const shown = entries.filter(({ tab }) => !tab.hidden);
    const at = shown.findIndex(({ tab }) => tab === document.activeElement);
    const next = { Home: 0, End: shown.length - 1 }[event.key] ?? (event.key in STEPS ? (at + STEPS[event.key] + shown.length) % shown.length : -1);
    if (next < 0) return;
    event.preventDefault();
    choose(shown[next].name);
    shown[next].tab.focus();
  });
  element.append(list, ...entries.map(({ panel }) => panel));
  store.subscribe(["view tab", "welcome"], () => {
    for (const { name, tab } of entries) tab.hidden = name === "rig" && !store.get("welcome")?.rig;
    const shown = entries.filter(({ tab }) => !tab.hidden);
    const chosen = shown.find(({ name }) => name === store.get("view tab")) ?? shown[0];
    for (const each of entries) {
      each.panel.hidden = each !== chosen;
      each.tab.setAttribute("aria-selected", String(each === chosen));
      each.tab.tabIndex = each === chosen ? 0 : -1;
    }
  });
}
