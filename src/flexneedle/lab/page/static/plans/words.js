// Plans and their first estimate, in words.

import { shown } from "../dom.js";
import { isStale } from "../shown.js";

export const STRATEGIES = ["manipulation", "steering"];

// [text, stale] for each result. An estimate is one end that a small search has found: if it is near the target, the
// target is in reach; if not, only the plan shows whether it is.
export function planWords(store) {
  const found = [];
  const estimate = store.get("estimate");
  const plans = STRATEGIES.map((strategy) => store.get(`plan ${strategy}`)).filter(Boolean);
  if (estimate && !isStale(store, estimate) && plans.every((plan) => isStale(store, plan))) found.push([estimateWords(estimate), false]);
  for (const plan of plans) {
    const stale = isStale(store, plan);
    const to = plan.target_name ? `, ${plan.target_name}` : "";
    found.push([`${titled(plan.strategy)}${to}: ${plan.summary}${stale ? " (for an earlier state of the scenario)" : ""}.`, stale]);
  }
  return found;
}

function estimateWords({ error_mm: error, reached }) {
  const unknown = "; whether the target can be reached is not known yet";
  return `First estimate: ends ${shown(error, 2)} mm from the target${reached ? "" : unknown}.`;
}

const titled = (word) => word[0].toUpperCase() + word.slice(1);
