// Labels in space that keep their size on the screen.

import { CanvasTexture, Group, SRGBColorSpace, Sprite, SpriteMaterial } from "../vendor/three.js";

const SHARPNESS = 2; // pixels of the texture to a pixel of the page
const FONT = '12px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
const PAD = 3;

export class Labels {
  #scale = 1;

  constructor() {
    this.group = new Group();
    this.group.name = "labels";
  }

  // Add a label at a point [x, y, z] and return it. anchor: the part of the text at that point, [0, 0] is its lower left corner.
  add(text, point, color, anchor = [0.5, 0.5]) {
    const { canvas, width, height } = drawn(text, color);
    const texture = new CanvasTexture(canvas);
    texture.colorSpace = SRGBColorSpace;
    const material = new SpriteMaterial({ map: texture, depthTest: false, sizeAttenuation: false });
    const sprite = new Sprite(material);
    sprite.position.set(...point);
    sprite.center.set(...anchor);
    sprite.renderOrder = 20;
    sprite.userData = { text, width, height };
    this.group.add(sprite);
    this.#size(sprite);
    return sprite;
  }

  clear() {
    for (const sprite of this.group.children) {
      sprite.material.map.dispose();
      sprite.material.dispose();
    }
    this.group.clear();
  }

  // Fit a view of `height` pixels with a camera of field of view `fov` (deg).
  fit(height, fov) {
    this.#scale = (2 * Math.tan((fov * Math.PI) / 360)) / height;
    this.group.children.forEach((sprite) => this.#size(sprite));
  }

  #size(sprite) {
    const { width, height } = sprite.userData;
    sprite.scale.set(width * this.#scale, height * this.#scale, 1);
  }
}

function drawn(text, color) {
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d");
  pen.font = FONT;
  const [width, height] = [Math.ceil(pen.measureText(text).width) + 2 * PAD, 18];
  [canvas.width, canvas.height] = [width * SHARPNESS, height * SHARPNESS];
  pen.scale(SHARPNESS, SHARPNESS);
  pen.font = FONT;
  pen.fillStyle = color;
  pen.textBaseline = "middle";
  pen.fillText(text, PAD, height / 2);
  return { canvas, width, height };
}
