// The sensors along the needle in words, at the shown period: a line for each, and how well the tip is known.

import { brief, make, renew } from "../dom.js";
import { SHOWN, shownOf, shownRow } from "../shown.js";

const BAND = 1.96; // of a 95 % band, in standard deviations

export function followSensors(element, store) {
  const list = make("ul.sensors", { "aria-label": "Sensors along the needle", hidden: true });
  element.append(list);
  store.subscribe(SHOWN, () => {
    const row = shownRow(store);
    const sensors = row?.sensors ?? [];
    list.hidden = !sensors.length;
    const rows = sensors.length ? store.get(`rows ${shownOf(store)}`).slice(0, row.index + 1) : [];
    renew(list, [...tip(row), ...sensors.map((sensor, at) => line(sensor, newest(rows, at)))]);
  });
}

function line({ name, verdict }, nis) {
  const innovation = `innovation ${brief(nis)} (1 on average)`;
  if (verdict === "ok") return make("li", {}, `${name}: used, ${innovation}`);
  return make("li.bad", {}, `${name}: excluded, ${verdict}; ${innovation}`);
}

// The last known innovation: a slow sensor has none in most periods.
const newest = (rows, at) => rows.findLast(({ sensors }) => (sensors?.[at]?.nis ?? null) !== null)?.sensors[at].nis;

function tip(row) {
  if (!row?.tip_covariance) return [];
  const [, [, yy, yz], [, , zz]] = row.tip_covariance;
  const largest = (yy + zz) / 2 + Math.hypot((yy - zz) / 2, yz);
  return [make("li", {}, `Estimated tip: ± ${brief(BAND * Math.sqrt(largest))} mm across (95 %)`)];
}
