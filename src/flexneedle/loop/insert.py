"""Insertions on the virtual phantom, or on the rig of a rig file."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from flexneedle.arguments import whole
from flexneedle.control.controllers import DEFAULT
from flexneedle.control.interface import Controller
from flexneedle.errors import InputError, RigError
from flexneedle.lab.rig.dry_run import in_memory
from flexneedle.lab.rig.rig_file import RigFile, load_rig
from flexneedle.lab.rig.supervised import Watchers, check_fit, supervised
from flexneedle.loop.closed_loop import planned, run
from flexneedle.loop.parts import SCENARIO_TRACKER, TrackerFactory, plant_of, tracker_of
from flexneedle.loop.step import OnDecision
from flexneedle.loop.virtual import Seeds, virtual_rig
from flexneedle.phantom.plants import DEFAULT_PLANT, PlantFactory
from flexneedle.planning.origin import placed
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.types import Insertion, Period, Plan


def insert(
    scenario: str | Path | Scenario,
    plan: Plan,
    seed: int = 0,
    *,
    controller: str | Controller = DEFAULT,
    phantom: str | PlantFactory = DEFAULT_PLANT,
    tracker: str | TrackerFactory = SCENARIO_TRACKER,
    force: bool = False,
    threads: int | None = None,
    on_period: Callable[[Period], None] | None = None,
    on_decision: OnDecision | None = None,
    rig: str | Path | RigFile | None = None,
    dry_run: bool = False,
    watchers: Watchers | None = None,
) -> Insertion:
    """Execute `plan` in closed loop in the virtual phantom drawn with `seed`; return the complete record.

    rig: a rig file, on whose motors and tracker the plan is executed in place of the virtual phantom, from where the
    motors are. dry_run: its motors and tracker are read; motors never move, and the needle is the virtual phantom's.
    watchers: are given the rig before it is armed, which they may refuse, and each of its ticks (default: only the
    record is).

    scenario: a scenario, or its name or path as for `load_scenario`. It must be the plan's own, or differ from it only
    in controller, tracker, monitor and phantom.
    controller: one of `control.controllers.CONTROLLERS`; phantom: "exact" or "model", the kind of plant; tracker:
    "scenario", the one that the scenario describes. Each may also be an object of your own or its name `module:NAME`
    (docs/extend.md).
    threads: for rollouts (default: all cores), without effect on the result. on_period: called with each control
    period when it ends; on_decision: with each decision of the controller, before anything moves, and the estimate that
    it was made on.

    The record is the same for the same seed, except for wall-clock durations.

    Raises InputError for an unknown name, an unsuitable object, a plan of another scenario, or a controller that needs
    the guide where it may not move; RigError for a rig that breaks a rule, does not fit the scenario, or has a section
    `ros` that nothing follows; DriverError if one of its devices cannot be opened, StoppedError if it is stopped before
    the first motion; ScenarioError for a setting that the controllers reject; RunError if the plan misses its target by
    more than 1 mm, unless `force` is set or the controller predicts the miss itself, as the default one does.
    """
    scenario, plan, seed = load_scenario(scenario), planned(plan), whole("seed", seed, 0)
    plant_name, plant = plant_of(phantom)
    tracker_name, own_tracker = tracker_of(tracker)
    scenario = placed(scenario, plan)
    virtual = virtual_rig(scenario, plan.roll, Seeds.of(seed), plant, tracker=own_tracker)
    executed = partial(
        run,
        scenario,
        plan,
        rng=Seeds.controller(seed),
        seed=seed,
        controller=controller,
        force=force,
        threads=threads,
        on_period=on_period,
        on_decision=on_decision,
    )
    if rig is None:
        return replace(executed(virtual), phantom=plant_name, tracker=tracker_name)
    if (plant_name, tracker_name) != (DEFAULT_PLANT, SCENARIO_TRACKER):
        raise InputError("phantom and tracker are those of the rig: give neither with a rig")
    file = rig if isinstance(rig, RigFile) else load_rig(rig)
    check_fit(file, scenario, plan.strategy)
    watchers = _checked(watchers or Watchers(), file)
    with supervised(file, scenario, plan, watchers, dry=dry_run) as ports:
        insertion = executed(in_memory(ports, virtual) if dry_run else ports)
    return replace(insertion, rig=file.name, ticks=watchers.ticks.summary(), dry_run=dry_run)


def _checked(watchers: Watchers, rig: RigFile) -> Watchers:
    """The watchers of a rig. Raises RigError if none of them follows the stop of its section `ros`."""
    if rig.ros is not None and not watchers.followers:
        rule = "give watchers=Watchers(followers=(Bridge(rig.ros),)), see flexneedle.lab.ros.bridge"
        raise RigError(f"ros: nothing listens to the stop of this section: {rule}")
    return watchers
