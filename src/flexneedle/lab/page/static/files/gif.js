// A GIF (89a, looping) of drawings, with a palette of 6 × 6 × 6 colours and 39 greys.

const GREYS = 39;
const COLORS = 256;
const CODE_BITS = 8;
const LAST_CODE = 4095;

const PALETTE = paletteOf();

export class Gif {
  #bytes = [];
  #delay;

  // width, height: px; delay: s of each frame.
  constructor(width, height, delay) {
    [this.width, this.height, this.#delay] = [width, height, delay];
    const bytes = this.#bytes;
    text(bytes, "GIF89a");
    words(bytes, width, height);
    bytes.push(0xf7, 0, 0, ...PALETTE.flat(), 0x21, 0xff, 11);
    text(bytes, "NETSCAPE2.0");
    bytes.push(3, 1, 0, 0, 0); // endless
  }

  // Encode a frame. pixels: RGBA, as of getImageData.
  add(pixels) {
    const bytes = this.#bytes;
    bytes.push(0x21, 0xf9, 4, 0);
    words(bytes, Math.max(2, Math.round(100 * this.#delay)));
    bytes.push(0, 0, 0x2c);
    words(bytes, 0, 0, this.width, this.height);
    bytes.push(0, CODE_BITS);
    blocks(bytes, compressed(indices(pixels)));
  }

  // Return the complete file.
  bytes() {
    this.#bytes.push(0x3b);
    return Uint8Array.from(this.#bytes);
  }
}

function paletteOf() {
  const colors = [];
  for (let at = 0; at < 216; at++) colors.push([Math.floor(at / 36), Math.floor(at / 6) % 6, at % 6].map((part) => 51 * part));
  for (let at = 0; at < GREYS; at++) colors.push(Array(3).fill(Math.round((255 * (at + 0.5)) / GREYS)));
  while (colors.length < COLORS) colors.push([0, 0, 0]);
  return colors;
}

// Colour of each pixel: a grey if it is nearly grey.
function indices(pixels) {
  const found = new Uint8Array(pixels.length / 4);
  for (let at = 0; at < found.length; at++) {
    const [r, g, b] = [pixels[4 * at], pixels[4 * at + 1], pixels[4 * at + 2]];
    const grey = Math.max(r, g, b) - Math.min(r, g, b) < 10 && r > 0 && r < 255;
    found[at] = grey ? 216 + Math.min(GREYS - 1, Math.floor((g * GREYS) / 256)) : 36 * level(r) + 6 * level(g) + level(b);
  }
  return found;
}

const level = (part) => Math.round(part / 51);

// Lempel–Ziv–Welch codes of growing length, least bit first.
function compressed(values) {
  const clear = 1 << CODE_BITS;
  const out = [];
  let [bits, count, size, next] = [0, 0, CODE_BITS + 1, clear + 2];
  let table = new Map();
  const write = (code) => {
    bits |= code << count;
    count += size;
    for (; count >= 8; count -= 8, bits >>>= 8) out.push(bits & 255);
  };
  write(clear);
  let prefix = values[0];
  for (let at = 1; at < values.length; at++) {
    const key = prefix * 256 + values[at];
    const known = table.get(key);
    if (known !== undefined) {
      prefix = known;
      continue;
    }
    write(prefix);
    if (next > LAST_CODE) {
      write(clear);
      [table, size, next] = [new Map(), CODE_BITS + 1, clear + 2];
    } else {
      if (next === 1 << size) size += 1;
      table.set(key, next++);
    }
    prefix = values[at];
  }
  write(prefix);
  if (next === 1 << size && size < 12) size += 1;
  write(clear + 1);
  if (count) out.push(bits & 255);
  return out;
}

function blocks(bytes, data) {
  for (let at = 0; at < data.length; at += 255) {
    const part = data.slice(at, at + 255);
    bytes.push(part.length);
    for (const byte of part) bytes.push(byte);
  }
  bytes.push(0);
}

function text(bytes, letters) {
  for (const letter of letters) bytes.push(letter.charCodeAt(0));
}

function words(bytes, ...values) {
  for (const value of values) bytes.push(value & 255, value >> 8);
}
