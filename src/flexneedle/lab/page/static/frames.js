// Binary frames of shapes: the counterpart of page/shape_frames.py, which is the reference.

export const Kind = Object.freeze({
  NEEDLE: 1, TRUE: 2, PREDICTED: 3, SAMPLES: 4, PATH: 5, CHANNEL: 6, REACH: 7, SWEEP: 8,
});
export const Source = Object.freeze({ SCENE: 0, LIVE: 1, FIRST: 2, SECOND: 3, MANIPULATION: 4, STEERING: 5 });

const HEADER = 16;
const MOST_VALUES = 4_000_000;

const known = (names, value) => Object.values(names).includes(value);

// The frame of an ArrayBuffer: {kind, source, number, paths, points, columns, values}; values is a Float32Array,
// path by path, point by point. Throws RangeError for invalid bytes.
export function unpacked(buffer) {
  if (buffer.byteLength < HEADER) {
    throw new RangeError(`a frame of ${buffer.byteLength} bytes: must have at least ${HEADER}`);
  }
  const view = new DataView(buffer);
  const [kind, columns, source, zero] = [0, 1, 2, 3].map((at) => view.getUint8(at));
  const [number, paths, points] = [4, 8, 12].map((at) => view.getUint32(at, true));
  const values = paths * points * columns;
  if (zero || values > MOST_VALUES || buffer.byteLength !== HEADER + 4 * values) {
    throw new RangeError(
      `a frame of ${buffer.byteLength} bytes does not have ${paths} x ${points} x ${columns} values`,
    );
  }
  if (!known(Kind, kind) || !known(Source, source)) {
    throw new RangeError(`a frame of kind ${kind} and source ${source}: unknown`);
  }
  return { kind, source, number, paths, points, columns, values: floats(buffer) };
}

// Path `index` of a frame, as a view of its values.
export function pathOf(frame, index) {
  const size = frame.points * frame.columns;
  return frame.values.subarray(index * size, (index + 1) * size);
}

function floats(buffer) {
  if (new Uint8Array(new Uint16Array([1]).buffer)[0] === 1) return new Float32Array(buffer, HEADER);
  const view = new DataView(buffer, HEADER); // a big-endian machine
  return Float32Array.from({ length: view.byteLength / 4 }, (_, at) => view.getFloat32(4 * at, true));
}
