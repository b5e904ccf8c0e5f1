// The part of space that the views show.

const [BEHIND, BEYOND, AROUND, STEP] = [8, 8, 4, 5]; // mm
const FARTHEST = 20; // mm, of a zone from the axis

// The box that is drawn, {left, right, half}: from behind the guide to beyond the target, as wide as it is high. others: further targets.
export function boxOf(scene, target, others = []) {
  const points = others.map(({ position }) => position);
  const tip = scene.base[0] + scene.needle_length_mm;
  const left = Math.min(scene.guide ? scene.guide[0] : tip, tip, 0) - BEHIND;
  const deepest = scene.layers.at(-1)?.top_mm ?? 0;
  const off = ([, y, z]) => [Math.abs(y), Math.abs(z)];
  const zones = (scene.zones ?? []).flatMap(Object.entries).filter(([key]) => !key.endsWith("point_mm")).flatMap(([, place]) => off(place));
  const across = Math.max(...[target, ...points, scene.guide ?? target].flatMap(off), ...zones.map((each) => Math.min(each, FARTHEST)));
  return {
    left: STEP * Math.floor(left / STEP),
    right: STEP * Math.ceil((Math.max(target[0], deepest, ...points.map(([x]) => x)) + BEYOND) / STEP),
    half: Math.max(2 * STEP, STEP * Math.ceil((across + AROUND) / STEP)),
  };
}
