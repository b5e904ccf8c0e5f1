// The web socket: connects and reconnects automatically, matches answers to requests, passes messages to the store.

import { unpacked } from "./frames.js";
import { afterRestart, restoreOf } from "./restart.js";
import { retracts, runs } from "./shown.js";

const WAITS = [250, 500, 1000, 2000, 4000]; // ms before the next attempts
const EDIT_EVERY = 50; // ms
const MOST_REFUSALS = 20;
const ANSWER_WITHIN = 10_000; // ms
const LOOK_EVERY = 1000; // ms between two checks of the server
const MOST_SILENT = 4; // checks without a message: more, and the line is dead, which a browser notices after minutes
const NO_STOP = "There is no connection to the server: the stop was not sent. On a rig, use its own stop.";
const FREE = ["steer", "stop", "ping", "restore"]; // requests that need no control

export class Link {
  #store;
  #address;
  #socket = null;
  #attempts = 0;
  #timer = 0;
  #number = 0;
  #before = null; // session of this page before the server was restarted, until the new one's arrives
  #silent = 0; // checks since the last message; not a time, since a page that was suspended has messages pending
  #waiting = new Map(); // by number of the request: {resolve, timer}
  #taking = null; // answer to the request for control
  #edits = {};
  #editTimer = 0;
  #lastEdit = -Infinity;

  // store.js; address of the web socket (default: /live of this page).
  constructor(store, address = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`) {
    this.#store = store;
    this.#address = address;
    setInterval(() => this.#look(), LOOK_EVERY);
  }

  // Connect, now and whenever the connection is lost. Store key "connection": connecting, open, lost; "connection
  // reason": the server's reason, which may be empty.
  connect() {
    clearTimeout(this.#timer);
    this.#timer = 0;
    this.#store.set("connection", this.#attempts ? "lost" : "connecting");
    const socket = new WebSocket(this.#address);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => this.#receive(data);
    socket.onclose = ({ reason }) => this.#lost(socket, reason);
    this.#socket = socket;
    this.#silent = 0;
  }

  // Send a request. Resolves to {done: true} or {done: false, reason, problems}; never rejects. A request that
  // needs control takes it first if nobody is in control; those made meanwhile follow it. A refusal is shown to the user
  // unless `quiet`.
  async ask(message, { quiet = false } = {}) {
    if (this.#mustSteer(message)) this.#taking ??= this.#take();
    if (this.#taking && !FREE.includes(message.type)) {
      const steering = await this.#taking;
      if (!steering.done) return this.#judged(steering, quiet);
    }
    return this.#judged(await this.#send(message), quiet);
  }

  // Change values of the scenario by key. Edits are merged and sent at most 20 times a second; until the last is
  // answered, store key "draft" contains them for all panels.
  edit(values) {
    this.#store.set("draft", { ...this.#store.get("draft"), ...values });
    Object.assign(this.#edits, values);
    this.#editTimer ||= setTimeout(() => this.#sendEdits(), this.#lastEdit + EDIT_EVERY - performance.now());
  }

  // Report that no edit follows, as when a drag ends: the plan is made at once.
  rest() {
    if (this.#editTimer) {
      clearTimeout(this.#editTimer);
      this.#sendEdits();
    }
    this.ask({ type: "rest" }, { quiet: true });
  }

  async #sendEdits() {
    this.#editTimer = 0;
    this.#lastEdit = performance.now();
    const values = this.#edits;
    this.#edits = {};
    const answer = await this.ask({ type: "edit", values });
    this.#settle(values);
    return answer;
  }

  // Drop values of the draft that no later edit has changed: they are accepted, or refused.
  #settle(values) {
    const draft = { ...this.#store.get("draft") };
    for (const [key, value] of Object.entries(values)) {
      if (Object.is(draft[key], value) && !(key in this.#edits)) delete draft[key];
    }
    this.#store.set("draft", Object.keys(draft).length ? draft : undefined);
  }

  #mustSteer(message) {
    const clients = this.#store.get("clients");
    return !FREE.includes(message.type) && clients?.steering === null;
  }

  async #take() {
    const answer = await this.#send({ type: "steer", take: true });
    this.#taking = null;
    return answer;
  }

  #send(message) {
    if (this.#socket?.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ done: false, reason: message.type === "stop" ? NO_STOP : "There is no connection to the server.", problems: {} });
    }
    const request = ++this.#number;
    this.#socket.send(JSON.stringify({ ...message, request }));
    const late = () => this.#answer(request, { done: false, reason: "The server has not answered.", problems: {} });
    const timer = setTimeout(late, ANSWER_WITHIN);
    return new Promise((resolve) => this.#waiting.set(request, { resolve, timer }));
  }

  #judged(answer, quiet) {
    if (!answer.done && !quiet) this.#refuse(answer);
    return answer;
  }

  // action: {text, call} of a button, without which the refusal disappears after some seconds.
  #refuse({ reason, problems, action }) {
    const refusals = this.#store.get("refusals") ?? [];
    const newest = { reason, problems: problems ?? {}, action, number: (refusals.at(-1)?.number ?? 0) + 1 };
    this.#store.set("refusals", [...refusals, newest].slice(-MOST_REFUSALS));
  }

  #look() {
    const socket = this.#socket;
    if (!socket || this.#timer) return;
    this.#silent += 1;
    if (this.#silent > MOST_SILENT) {
      this.#lost(socket, "the server is silent");
      socket.close(); // which may take as long
    } else if (this.#silent > 1) this.#send({ type: "ping" });
  }

  #receive(data) {
    this.#silent = 0;
    if (data instanceof ArrayBuffer) {
      this.#store.receiveFrame(unpacked(data));
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "done") this.#answer(message.request, { done: true });
    else if (message.type === "refused") this.#refused(message);
    else this.#news(message);
  }

  #refused({ request, reason, problems }) {
    if (this.#waiting.has(request)) this.#answer(request, { done: false, reason, problems: problems ?? {} });
    else this.#refuse({ reason, problems });
  }

  #news(message) {
    if (message.type === "welcome") {
      this.#attempts = 0;
      this.#store.set("connection", "open");
      this.#before = this.#sessionBefore(message);
    }
    if (message.type === "clients") this.#reportLoss(message);
    this.#store.receive(message);
    if (message.type === "session" && this.#before) this.#recover(message);
  }

  // The session of this page, which a restarted server does not know; null otherwise.
  #sessionBefore({ started }) {
    const [welcome, session, live] = ["welcome", "session", "insertion live"].map((key) => this.#store.get(key));
    if (!welcome || welcome.started === started) return null;
    const left = retracts(this.#store) || Boolean(runs(live) && live.rig);
    return session ? { welcome, session, ran: left || runs(live), left } : this.#before;
  }

  async #recover(session) {
    const before = this.#before;
    this.#before = null;
    const { line, restores, offers } = afterRestart(before, this.#store.get("welcome"), session);
    const request = restoreOf(before.session);
    const answer = restores ? await this.ask(request, { quiet: true }) : { done: true };
    const action = { text: "Put this page's scenario back", call: () => this.#putBack(request) };
    if (!answer.done) this.#refuse({ reason: `The server was restarted without this page's scenario: ${answer.reason}`, action });
    else if (line) this.#refuse({ reason: line, action: offers && action });
  }

  async #putBack(request) {
    const steering = this.#mustSteer({ type: "edit" }) ? await this.ask({ type: "steer", take: true }) : { done: true };
    if (steering.done) await this.ask(request);
  }

  // Another page has taken over this page's control.
  #reportLoss({ steering }) {
    const [own, before] = [this.#store.get("welcome")?.client, this.#store.get("clients")?.steering];
    if (before !== own || steering === own || (steering ?? null) === null) return;
    this.#refuse({ reason: `Person ${steering} has taken over control. This page can still stop an insertion.` });
  }

  #answer(request, answer) {
    const { resolve, timer } = this.#waiting.get(request) ?? {};
    clearTimeout(timer);
    this.#waiting.delete(request);
    resolve?.(answer);
  }

  #lost(socket, reason) {
    if (socket !== this.#socket) return;
    socket.onmessage = this.#socket = null;
    for (const request of [...this.#waiting.keys()]) {
      this.#answer(request, { done: false, reason: "The connection to the server was lost.", problems: {} });
    }
    const wait = WAITS[Math.min(this.#attempts, WAITS.length - 1)];
    this.#attempts += 1;
    this.#store.set("connection", "lost");
    this.#store.set("connection reason", reason);
    this.#timer = setTimeout(() => this.connect(), wait);
  }
}
