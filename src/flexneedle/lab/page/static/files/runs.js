// Recorded runs and studies: open a run or a row, a second to compare, download; save the last insertion or a row as a run.

import { arrange, button, make } from "../dom.js";
import { fetched } from "./download.js";
import { showStudy } from "./study.js";

const DOWNLOADS = [["Figure", "figure.png"], ["CSV", "trace.csv"], ["Run folder", "run.zip"], ["Replay as HTML", "replay.html"]];
const NAME = /^[A-Za-z0-9][A-Za-z0-9 ._-]{0,79}$/;
const RULE = "The name must begin with a letter (A–Z, a–z) or digit, and have at most 80 of these, spaces, points, - and _.";
const ENDED = ["done", "held", "failed", "interrupted"];
const REPLAYED = ["insertion"]; // kinds of runs that can be shown
const MOST = 100; // runs in the list

export function showRuns(element, store, link) {
  const search = make("input", { type: "search", placeholder: "Search the runs", "aria-label": "Search the runs" });
  const list = make("ul", { "aria-label": "Recorded runs" });
  const opened = make("div.opened");
  const save = saveForm(link, "live", "", "Save the insertion");
  const name = save.querySelector("input");
  let proposed = "";
  store.subscribe(["insertion live"], () => {
    const live = store.get("insertion live");
    const ended = ENDED.includes(live?.state);
    if (ended && save.hidden && name.value === proposed) name.value = proposed = defaultName(live);
    save.hidden = !ended;
  });
  const study = make("div");
  element.append(save, opened, study, make("details", { open: true }, make("summary", {}, "Recorded runs and studies"), search, list));
  showStudy(study, store, link);
  const entries = new Map(); // by name
  const show = () => showList(list, entries, search.value.trim().toLowerCase(), store, link);
  search.addEventListener("input", show);
  store.subscribe(["runs"], show);
  const shown = new Map(); // by opened run
  store.subscribe(["insertion first", "insertion second"], () => showOpened(opened, shown, store, link));
}

// Entries that remain keep their focus and an open list of downloads.
function showList(list, entries, text, store, link) {
  const found = (store.get("runs")?.runs ?? []).filter(({ name, summary, kind }) => `${name} ${kind} ${summary}`.toLowerCase().includes(text));
  const shown = found.slice(0, MOST).map((run) => {
    const known = entries.get(run.name);
    const entry = known?.kind === run.kind ? known : entryOf(run, link);
    entry.about.textContent = aboutOf(run);
    return [run.name, entry];
  });
  entries.clear();
  for (const [name, entry] of shown) entries.set(name, entry);
  const remarks = [];
  if (!found.length) remarks.push(text ? "No run matches" : "No recorded runs yet");
  if (found.length > MOST) remarks.push(`${found.length - MOST} more: search for them`);
  arrange(list, [...shown.map(([, { element }]) => element), ...remarks.map((remark) => make("li.quiet", {}, remark))]);
}

function entryOf({ name, kind }, link) {
  const about = make("span.quiet");
  const tools = make("div.tools", {}, ...(kind === "study" ? toolsOfStudy : toolsOfRun)(name, kind, link));
  return { kind, about, element: make("li.run", {}, make("strong", {}, name), about, tools) };
}

function aboutOf({ kind, summary, made }) {
  const when = new Date(1000 * made).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
  return `${kind}, ${when}: ${summary}`;
}

const toolsOfStudy = (name, kind, link) => [button("Rows", () => link.ask({ type: "study", name }), { "aria-label": `Rows of ${name}` })];

function toolsOfRun(name, kind, link) {
  const open = (second) => link.ask({ type: "open", name, second });
  const shows = REPLAYED.includes(kind)
    ? [button("Open", () => open(false), { "aria-label": `Open ${name}` }), button("Compare", () => open(true), { "aria-label": `Compare with ${name}` })]
    : [];
  const status = make("div", { role: "status" });
  const downloads = DOWNLOADS.map(([text, file]) => downloadOf(name, file, text, status));
  return [...shows, make("details", {}, make("summary", {}, "Download"), make("div.tools", {}, ...downloads), status)];
}

function downloadOf(name, file, text, status) {
  const [href, what] = [addressOf(name, file), `${text} of ${name}`];
  const click = (event) => {
    event.preventDefault();
    fetched(href, `${name}-${file}`, what, status);
  };
  return make("a", { href, download: `${name}-${file}`, "aria-label": what, click }, text);
}

const addressOf = (name, file) => `/runs/${encodeURIComponent(name)}/${file}`;

// Scenario, target if there are others, controller and time of day, as a valid name.
function defaultName({ name, controller, target_name: target }) {
  const now = new Date(Date.now() - 60_000 * new Date().getTimezoneOffset()).toISOString();
  const text = `${[name, target, controller].filter(Boolean).join("-")}-${now.slice(0, 19).replace("T", "-")}`;
  return text.replace(/[^A-Za-z0-9 ._-]/g, "-").replace(/^[^A-Za-z0-9]+/, "").slice(-80);
}

// A run that stays open keeps the focus and a name that is being written.
function showOpened(element, shown, store, link) {
  const lines = [["first", false, "Shown"], ["second", true, "Compared with"]].flatMap(([of, second, what]) => {
    const insertion = store.get(`insertion ${of}`);
    if (!insertion) return [];
    const { name, controller, seed, row } = insertion;
    const key = JSON.stringify([of, name, controller, seed, row]);
    return [[key, shown.get(key) ?? linesOf(of, second, what, insertion, link)]];
  });
  shown.clear();
  for (const [key, line] of lines) shown.set(key, line);
  arrange(element, lines.flatMap(([, line]) => line));
}

function linesOf(of, second, what, { name, controller, seed, row }, link) {
  const close = button("Close", () => link.ask({ type: "open", name: null, second }), { "aria-label": `Close ${name}` });
  const line = make("p.tools", {}, make("span", {}, `${what}: ${name} (${controller}, seed ${seed})`), close);
  return row === null ? [line] : [line, saveForm(link, of, name.replaceAll(",", ""), "Save as a run")];
}

// The last insertion, or the shown row of a study.
function saveForm(link, of, proposed, text) {
  const name = make("input", { type: "text", maxlength: "80", value: proposed, placeholder: "Name of the run", "aria-label": proposed ? `Name to save ${proposed} as` : "Name of the run to save" });
  const problem = make("p.problem.bad", { role: "alert", hidden: true }, RULE);
  const form = make("form.tools", {}, name, make("button", { type: "submit" }, text), problem);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const written = name.value;
    const valid = NAME.test(written.trim());
    name.setAttribute("aria-invalid", valid ? "false" : "true");
    problem.hidden = valid;
    if (valid && (await link.ask({ type: "save", name: written.trim(), of })).done && name.value === written) name.value = "";
  });
  return form;
}
