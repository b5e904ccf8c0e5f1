"""The scenario of a plan, and the check that a plan may be carried out in another."""

from flexneedle.errors import InputError
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario

PLANNER_INPUTS = ("needle", "setup", "tissue", "contact", "entry", "target", "image", "zones", "zone", "plan")
"""Sections of a scenario that a plan depends on. It may be carried out with any other controller, tracker, monitor or
phantom."""


def with_planned_entry(scenario: Scenario, plan: Plan) -> Scenario:
    """Return the scenario with the entry that a plan has chosen, where it is free."""
    made = plan.scenario
    if made is None or not scenario.entry.free:
        return scenario
    return scenario.with_values({f"entry.{key}": value for key, value in made.entry.model_dump().items()})


def check_origin(plan: Plan, scenario: Scenario) -> None:
    """Raise InputError, with the first key that differs, if a plan was made for another scenario.

    Its target may have been given to the planner in place of the scenario's: it only has to be the plan's or the same
    in both. A plan without a scenario is accepted.
    """
    made = plan.scenario
    if made is None:
        return
    own_target = plan.target == scenario.target.position
    sections = [name for name in PLANNER_INPUTS if not (own_target and name == "target")]
    if (found := made.first_difference(scenario, sections)) is not None:
        rule = "make a plan for this scenario, or use the scenario of the plan (plan.scenario)"
        raise InputError(f"{found.key} = {found.new}: the plan was made with {found.old}: {rule}")
