// Files that the browser saves.

import { make } from "../dom.js";

function download(blob, name) {
  const address = URL.createObjectURL(blob);
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

// Request a file from the server, and save it. what: its name in words; status: element for progress or the reason of a
// refusal.
export async function fetched(address, name, what, status) {
  const line = make("p.quiet", {}, `${what} is being made…`);
  for (const earlier of status.querySelectorAll(".bad")) earlier.remove();
  status.append(line);
  try {
    const answer = await fetch(address, { cache: "no-store" });
    if (!answer.ok) throw new Error(await answer.text());
    download(await answer.blob(), name);
    line.remove();
  } catch (error) {
    line.className = "bad";
    line.textContent = `${what}: ${error instanceof TypeError ? "the server does not answer" : error.message}`;
  }
}

// Save the shown view of the scene as a PNG on the ground of its stage.
export async function savePicture(store) {
  const [{ spaceView }, { sectionView }] = await Promise.all([import("../space.js"), import("../section.js")]);
  const view = store.get("view scene") === "section" ? sectionView() : spaceView();
  const canvas = view.drawn(); // explicitly: WebGL keeps no picture
  const picture = make("canvas", { width: canvas.width, height: canvas.height });
  const pen = picture.getContext("2d");
  pen.fillStyle = getComputedStyle(canvas.parentElement).backgroundColor;
  pen.fillRect(0, 0, picture.width, picture.height);
  pen.drawImage(canvas, 0, 0);
  picture.toBlob((blob) => download(blob, "flexneedle.png"));
}
