// State of the page by key. A message of the server is the state of its key (as `ServerMessage.key` in protocol.py):
//   "session", "scene", "clients", "job plan", "iteration steering", "plan manipulation", "insertion live", …
//   "rows live" | "rows first" | "rows second": all rows, by index
//   "shape KIND SOURCE", such as "shape needle live": the newest frame; `track` has the frames of all periods
// State of this browser alone has keys that begin with "view ", and "connection", "refusals", "draft".
//
// A subscriber is called once before the next paint, for any number of changed keys.

import { Kind, Source, pathOf } from "./frames.js";
import { runs } from "./shown.js";

const KINDS = Object.keys(Kind).map((name) => name.toLowerCase());
const SOURCES = Object.keys(Source).map((name) => name.toLowerCase());
const BY = { job: "kind", iteration: "strategy", plan: "strategy", rows: "of", insertion: "of", zones: "of" };
const BEFORE_ROWS = ["waiting", "planning"];
const STAY = ["samples", "channel"];
const RECORDED = ["first", "second"];
const INSERTIONS = ["live", ...RECORDED];
const OWN = /^(view |connection|refusals$|draft$)/;
const PLANS = /^((iteration|plan) .*|reach|estimate|shape \w+ (manipulation|steering)|zones scene|shape (needle|path|samples|reach|sweep) scene)$/;

// Key of a message of the server.
export function keyOf(message) {
  const by = BY[message.type];
  return by ? `${message.type} ${message[by]}` : message.type;
}

export class Store {
  #values = new Map();
  #tracks = new Map(); // "needle live" → array of paths by period
  #before = new Map(); // by key: insertions of the lost connection
  #listeners = new Set();
  #changed = new Set();
  #frame = 0;

  get(key) {
    return this.#values.get(key);
  }

  // Keys that begin with a text.
  keys(beginning) {
    return [...this.#values.keys()].filter((key) => key.startsWith(beginning));
  }

  // Set a key; undefined removes it. An equal value changes nothing.
  set(key, value) {
    if (Object.is(this.#values.get(key), value)) return;
    if (value === undefined) this.#values.delete(key);
    else this.#values.set(key, value);
    this.#mark(key);
  }

  // Call `listener` when one of the keys has changed; a key that ends in a blank stands for all that begin with it
  // ("job "). Called a first time before the next paint. Returns a function that ends it.
  subscribe(keys, listener) {
    const entry = { keys, listener, first: true };
    this.#listeners.add(entry);
    this.#schedule();
    return () => this.#listeners.delete(entry);
  }

  // Take a message of the server.
  receive(message) {
    if (message.type === "rows") this.#receiveRows(message);
    else if (message.type === "closed") this.#close(message);
    else this.#receiveState(message);
  }

  #receiveState(message) {
    const key = keyOf(message);
    const earlier = this.get(key);
    if (message.type === "insertion") this.#announce(key, message);
    if (message.type === "iteration") this.set("view searched", message.strategy);
    if (message.type === "welcome") this.#forgetAll();
    if (message.type === "session" && message.name !== earlier?.name) this.#forgetPlans();
    this.set(key, message);
  }

  // Take a frame (`unpacked` of frames.js).
  receiveFrame(frame) {
    const kind = KINDS[Object.values(Kind).indexOf(frame.kind)];
    const source = SOURCES[Object.values(Source).indexOf(frame.source)];
    if (INSERTIONS.includes(source)) this.#keep(kind, source, frame);
    this.set(`shape ${kind} ${source}`, frame);
  }

  // The shape of an insertion at a period: {period, paths, points, columns, values}, or null. Samples and cut channel, which
  // not every period has: the newest until then.
  track(kind, source, period = Infinity) {
    const track = this.#tracks.get(`${kind} ${source}`) ?? [];
    let at = Math.min(period, track.length - 1);
    while (STAY.includes(kind) && at >= 0 && !track[at]) at--;
    return track[at] ?? null;
  }

  #keep(kind, source, frame) {
    const name = `${kind} ${source}`;
    const track = this.#tracks.get(name) ?? [];
    this.#tracks.set(name, track);
    const { points, columns, number } = frame;
    if (kind === "samples" || kind === "reach" || kind === "sweep") {
      track[number] = { period: number, paths: frame.paths, points, columns, values: frame.values };
      return;
    }
    for (let at = 0; at < frame.paths; at++) {
      const values = pathOf(frame, at);
      if (!Number.isNaN(values[0])) track[number + at] = { period: number + at, paths: 1, points, columns, values };
    }
  }

  #receiveRows({ of, first, rows }) {
    const key = `rows ${of}`;
    const known = first === 0 ? [] : this.get(key) ?? []; // at 0 an insertion begins
    this.set(key, [...known.slice(0, first), ...rows, ...known.slice(first + rows.length)]);
  }

  // An insertion that begins, or a recording that is opened, takes the place of the last one, and is shown. After a
  // lost connection all are announced again: a known one does not change the shown state.
  #announce(key, message) {
    const known = this.get(key);
    const earlier = known ?? this.#before.get(key);
    this.#before.delete(key);
    const opened = Boolean(known) && RECORDED.includes(message.of);
    if (earlier && !opened && !isAnother(message, earlier)) return;
    this.#forget(message.of);
    if (message.of === "second" && this.get("view of") === "scene") this.set("view of", undefined); // the scene is not compared
    if (message.of === "first" || (message.of === "live" && runs(message))) this.set("view newest", message.of);
  }

  #close({ of }) {
    this.#before.delete(`insertion ${of}`);
    this.#forget(of);
    this.set(`insertion ${of}`, undefined);
  }

  #forget(of) {
    if (of !== "second") for (const key of ["view of", "view period"]) this.set(key, undefined);
    for (const what of ["rows", "zones"]) this.set(`${what} ${of}`, undefined);
    for (const kind of KINDS) {
      this.#tracks.delete(`${kind} ${of}`);
      this.set(`shape ${kind} ${of}`, undefined);
    }
  }

  // A connection begins: the server sends its complete state.
  #forgetAll() {
    for (const key of this.keys("insertion ")) this.#before.set(key, this.get(key));
    this.#tracks.clear();
    for (const key of [...this.#values.keys()]) if (!OWN.test(key)) this.set(key, undefined);
  }

  // A plan of another revision of the same scenario is shown as outdated; of another scenario it is dropped.
  #forgetPlans() {
    for (const key of [...this.#values.keys()]) if (PLANS.test(key)) this.set(key, undefined);
  }

  #mark(key) {
    this.#changed.add(key);
    this.#schedule();
  }

  #schedule() {
    this.#frame ||= requestAnimationFrame(() => {
      this.#frame = 0;
      this.#notify();
    });
  }

  #notify() {
    const changed = this.#changed;
    this.#changed = new Set();
    for (const entry of this.#listeners) {
      if (!entry.first && !concerns(entry.keys, changed)) continue;
      entry.first = false;
      try {
        entry.listener();
      } catch (error) {
        reportError(error); // and the other panels continue
      }
    }
  }
}

function isAnother(message, earlier) {
  const begins = BEFORE_ROWS.includes(message.state) && !BEFORE_ROWS.includes(earlier.state);
  return begins || message.periods < earlier.periods || message.name !== earlier.name;
}

function concerns(keys, changed) {
  for (const key of keys) {
    if (changed.has(key)) return true;
    if (key.endsWith(" ")) for (const name of changed) if (name.startsWith(key)) return true;
  }
  return false;
}
