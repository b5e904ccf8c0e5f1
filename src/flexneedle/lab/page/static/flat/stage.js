// A sharp drawing in two dimensions that fills its element, drawn only when it has changed; hidden, it has no size.

const SHARPEST = 2; // device pixels to a pixel of the page

export class Stage {
  #draw;
  #frame = 0;
  width = 0;
  height = 0;

  // canvas: in an element with the class "stage"; draw: called with the pen (in pixels of the page) and this.
  constructor(canvas, draw) {
    [this.canvas, this.#draw] = [canvas, draw];
    this.pen = canvas.getContext("2d");
    new ResizeObserver(([{ contentRect }]) => this.#resize(contentRect)).observe(canvas.parentElement);
  }

  // Draw before the next paint.
  schedule() {
    this.#frame ||= requestAnimationFrame(() => {
      this.#frame = 0;
      this.draw();
    });
  }

  // Draw now.
  draw() {
    if (!this.width || !this.height) return;
    this.pen.setTransform(this.sharpness, 0, 0, this.sharpness, 0, 0);
    this.pen.clearRect(0, 0, this.width, this.height);
    this.#draw(this.pen, this);
  }

  // The canvas in its present state.
  drawn() {
    this.draw();
    return this.canvas;
  }

  #resize({ width, height }) {
    [this.width, this.height] = [width, height];
    this.sharpness = Math.min(devicePixelRatio, SHARPEST);
    this.canvas.width = Math.round(width * this.sharpness);
    this.canvas.height = Math.round(height * this.sharpness);
    this.draw();
  }
}
