// Plans and their first estimate, in words.

import { isStale } from "../shown.js";

export const STRATEGIES = ["manipulation", "steering"];

// [text, stale] for each result.
export function planWords(store) {
  const found = [];
  const estimate = store.get("estimate");
  const plans = STRATEGIES.map((strategy) => store.get(`plan ${strategy}`)).filter(Boolean);
  if (estimate && !isStale(store, estimate) && plans.every((plan) => isStale(store, plan))) found.push([`First estimate: ${estimate.summary}.`, false]);
  for (const plan of plans) {
    const stale = isStale(store, plan);
    const to = plan.target_name ? `, ${plan.target_name}` : "";
    found.push([`${titled(plan.strategy)}${to}: ${plan.summary}${stale ? " (for an earlier state of the scenario)" : ""}.`, stale]);
  }
  return found;
}

const titled = (word) => word[0].toUpperCase() + word.slice(1);
