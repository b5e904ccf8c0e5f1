// Pictures of what the page shows, made from its canvases: PNG of the scene, GIF of an insertion.

import { make } from "../dom.js";
import { shownOf } from "../shown.js";
import { gifOf } from "./gif.js";

const FRAMES = 60; // of a GIF at most
const [WIDTH, DELAY] = [640, 0.1]; // px at most, s

// Save the scene in space, or the section without WebGL, as a PNG.
export async function savePng() {
  const canvas = await drawing();
  const picture = copyOf(canvas, canvas.width);
  picture.toBlob((blob) => download(blob, "flexneedle.png"));
}

// Save a GIF of the shown insertion; progress(share) is called with each frame. Returns false where there is none.
export async function saveGif(store, progress) {
  const rows = store.get(`rows ${shownOf(store)}`) ?? [];
  if (!rows.length) return false;
  const before = store.get("view period");
  const frames = [];
  const count = Math.min(FRAMES, rows.length);
  let size = [0, 0];
  for (let at = 0; at < count; at++) {
    store.set("view period", count === 1 ? 0 : Math.round((at * (rows.length - 1)) / (count - 1)));
    await painted();
    const picture = copyOf(await drawing(), WIDTH);
    size = [picture.width, picture.height];
    frames.push(picture.getContext("2d").getImageData(0, 0, ...size).data);
    progress((at + 1) / count);
  }
  store.set("view period", before);
  download(new Blob([gifOf(...size, frames, DELAY)], { type: "image/gif" }), "flexneedle.gif");
  return true;
}

async function drawing() {
  const { spaceView } = await import("../space.js");
  return spaceView()?.drawn() ?? document.querySelector("[data-panel=section] canvas");
}

// A copy at most `widest` wide, on the ground of its stage.
function copyOf(canvas, widest) {
  const scale = Math.min(1, widest / canvas.width);
  const picture = make("canvas", { width: Math.round(canvas.width * scale), height: Math.round(canvas.height * scale) });
  const pen = picture.getContext("2d", { willReadFrequently: true });
  pen.fillStyle = getComputedStyle(canvas.parentElement).backgroundColor;
  pen.fillRect(0, 0, picture.width, picture.height);
  pen.drawImage(canvas, 0, 0, picture.width, picture.height);
  return picture;
}

const painted = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));

function download(blob, name) {
  const address = URL.createObjectURL(blob);
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}
