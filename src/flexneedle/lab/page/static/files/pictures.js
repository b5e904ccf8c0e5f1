// Pictures of the page's canvases: PNG of the scene, GIF of an insertion.

import { make } from "../dom.js";
import { shownOf } from "../shown.js";
import { download } from "./download.js";
import { Gif } from "./gif.js";

const FRAMES = 60; // of a GIF at most
const [WIDTH, DELAY] = [640, 0.1]; // px at most, s

// Save the scene in space, or the section without WebGL, as a PNG.
export async function savePng() {
  const canvas = await drawing();
  const picture = copyOf(canvas, canvas.width);
  picture.toBlob((blob) => download(blob, "flexneedle.png"));
}

// Save a GIF of the shown insertion; progress(share) is called with each frame, which is then encoded. Returns false without an insertion.
export async function saveGif(store, progress) {
  const rows = store.get(`rows ${shownOf(store)}`) ?? [];
  if (!rows.length) return false;
  const before = store.get("view period");
  const count = Math.min(FRAMES, rows.length);
  let gif = null;
  for (let at = 0; at < count; at++) {
    store.set("view period", count === 1 ? 0 : Math.round((at * (rows.length - 1)) / (count - 1)));
    await painted();
    const picture = copyOf(await drawing(), WIDTH);
    gif ??= new Gif(picture.width, picture.height, DELAY);
    gif.add(picture.getContext("2d").getImageData(0, 0, gif.width, gif.height).data);
    progress((at + 1) / count);
  }
  store.set("view period", before);
  download(new Blob([gif.bytes()], { type: "image/gif" }), "flexneedle.gif");
  return true;
}

async function drawing() {
  const [{ spaceView }, { sectionView }] = await Promise.all([import("../space.js"), import("../section.js")]);
  return (spaceView() ?? sectionView()).drawn(); // explicitly: a view off the screen is not drawn
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
