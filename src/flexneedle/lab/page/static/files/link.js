// A link that reproduces the scenario with its options: all is in the part after #, which no server gets.

import { maySteer, steers } from "../shown.js";
import { unlessChanged } from "./changes.js";
import { safe } from "./names.js";

const MARK = "#state=";

// Address of this page with the present state.
export async function linkOf(store) {
  const { name, seed, strategy, controller } = store.get("session");
  const text = await (await fetch("/scenario.toml", { cache: "no-store" })).text();
  const packed = await squeezed(JSON.stringify({ name, text, seed, strategy, controller }));
  return `${location.origin}${location.pathname}${MARK}${packed}`;
}

// Load the state of the address once connected, and of each link that is followed later. Where changes of the scenario
// would be lost it asks: any other page can send a browser to a link.
export function followLink(store, link, status) {
  let waits = false; // until this page is in control
  const take = async () => {
    if (!location.hash.startsWith(MARK)) return;
    const text = await unsqueezed(location.hash.slice(MARK.length)).catch(() => null);
    let state = null;
    try {
      state = JSON.parse(text);
    } catch {
      // as without one
    }
    waits = Boolean(state) && !maySteer(store);
    if (waits) {
      status.textContent = "The link is opened when you are in control";
      return;
    }
    history.replaceState(null, "", location.pathname + location.search); // a reload keeps what was changed since
    status.textContent = state ? "" : "The link is damaged: nothing was loaded";
    if (!state) return;
    const words = `The link has the scenario ${safe(String(state.name))}. To open it`;
    await unlessChanged(store, status, words, "Open the link", () => begin(link, state));
  };
  store.subscribe(["people", "welcome"], () => {
    if (waits && steers(store)) take(); // not as soon as nobody is: that may be between two connections of one who was
  });
  const end = store.subscribe(["people", "session"], () => {
    if (!store.get("people") || !store.get("session")) return;
    end();
    take();
  });
  addEventListener("hashchange", take);
}

async function begin(link, { name, text, seed, strategy, controller }) {
  const loaded = await link.ask({ type: "load", name: safe(name), text });
  if (loaded.done) await link.ask({ type: "options", seed, strategy, controller });
}

async function squeezed(text) {
  const bytes = new Uint8Array(await through(new Blob([text]), new CompressionStream("deflate-raw")).arrayBuffer());
  const letters = Array.from(bytes, (byte) => String.fromCharCode(byte)).join("");
  return btoa(letters).replaceAll("+", "-").replaceAll("/", "_").replace(/=+$/, "");
}

async function unsqueezed(packed) {
  const letters = atob(packed.replaceAll("-", "+").replaceAll("_", "/"));
  const bytes = Uint8Array.from(letters, (letter) => letter.charCodeAt(0));
  return through(new Blob([bytes]), new DecompressionStream("deflate-raw")).text();
}

const through = (blob, stream) => new Response(blob.stream().pipeThrough(stream));
