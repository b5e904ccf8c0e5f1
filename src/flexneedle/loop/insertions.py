"""Insertions: on the virtual phantom, on the rig of a rig file, or on ports of the caller."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from flexneedle.arguments import check_instance
from flexneedle.control import controller_tables
from flexneedle.control.controllers import DEFAULT, with_controller_defaults
from flexneedle.control.interface import Controller
from flexneedle.control.limits import check_guide, check_tracker
from flexneedle.errors import TO_INSERT_ANYWAY, RunError
from flexneedle.loop.choices import Choices
from flexneedle.loop.closed_loop import run
from flexneedle.loop.events import Ended, Gate, Stream
from flexneedle.loop.guard import Guard
from flexneedle.loop.rig import RigSource
from flexneedle.loop.step import Steering
from flexneedle.loop.virtual import Seeds
from flexneedle.planning.events import Listener
from flexneedle.planning.origin import check_origin, with_planned_entry
from flexneedle.results import TARGET_RADIUS_MM, Insertion, Plan, format_mm
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator


def insert(
    scenario: str | Path | Scenario,
    plan: Plan,
    seed: int = 0,
    *,
    controller: str | Controller = DEFAULT,
    rig: RigSource | None = None,
    force: bool = False,
    threads: int | None = None,
    listeners: Sequence[Listener] = (),
    gate: Gate | None = None,
) -> Insertion:
    """Execute a plan in closed loop and return the complete record.

    The record is the same for the same seed, except for wall-clock durations. If the insertion ends early, it
    has the reason and all periods until then: the outcome is "failed" after a DriverError of driver or tracker,
    "interrupted" after a stop at the rig, and "held" after a command that the rig refuses. The driver is stopped at the
    end, after an error and after an interrupt.

    Args:
        scenario: Scenario, or its name or path as for `load_scenario`. It may differ from the plan's own only in
            controller, tracker, monitor and phantom.
        plan: Plan to execute.
        seed: Seed of phantom, tracker and controller.
        controller: Name from `flexneedle insert --list`, `module:NAME`, or a Controller.
        rig: Source of the ports (default: `VirtualRig()`, the scenario's phantom and tracker). A `Rig` has custom
            ports; `flexneedle.devices.open_rig` gives the rig of a rig file, at its present positions.
        force: Insert even if the plan misses its target, and do not hold if a miss is predicted.
        threads: Threads of rollouts (default: all cores), without effect on the result.
        listeners: Functions that receive each event (`flexneedle.loop.events`).
        gate: Confirms that motors may be armed, and may hold the needle (default: neither).

    Raises:
        InputError: For an unknown name, an unsuitable object, a plan for another scenario, or a controller without
            the movable guide or the tracker that it needs.
        RigError: For a rig that breaks a rule or does not fit the scenario.
        DriverError: If a device cannot be opened, or stopped after another error.
        StoppedError: If the insertion is stopped before the first motion.
        ScenarioError: For a setting that the controller rejects.
        RunError: If the plan misses its target by more than 1 mm, unless `force` is set or the controller predicts the
            miss itself, as the default does; if it enters the margin of a zone, unless `force` is set.
    """
    scenario, plan = (
        load_scenario(scenario),
        check_instance("plan", plan, Plan, "make one with flexneedle.plan(scenario)"),
    )
    choices = Choices.of(seed, controller, rig, force=force, threads=threads)
    return carry_out(
        with_planned_entry(scenario, plan), plan, choices, Stream(tuple(listeners), gate or Gate())
    )


def check_choices(scenario: Scenario, strategy: str, choices: Choices) -> None:
    """Raise InputError for a controller whose guide may not move or without a tracker, RigError for an unfit rig."""
    check_guide(choices.controller, scenario.setup, strategy)
    check_tracker(choices.controller, scenario)
    choices.rig.check(scenario, strategy)


def carry_out(scenario: Scenario, plan: Plan, choices: Choices, stream: Stream) -> Insertion:
    """Execute a plan in its scenario, which has the plan's entry; otherwise as `insert`."""
    steering = prepare(scenario, plan, choices, stream)
    # Threads of a product of small matrices change its rounding, and wait for each other where other work runs.
    one_thread = threadpool_limits(1, user_api="blas")
    with one_thread, choices.rig.open(scenario, plan, choices.seed, stream) as ports:
        insertion = run(steering, ports)
    insertion = replace(insertion, **choices.parts, **choices.rig.results())
    reason = "; ".join(filter(None, (insertion.reason, choices.rig.explain(insertion))))
    insertion = replace(insertion, reason=reason)
    stream.send(Ended(insertion))
    return insertion


def prepare(scenario: Scenario, plan: Plan, choices: Choices, stream: Stream) -> Steering:
    """Return everything that the steps of an insertion need. Raises as `insert`, before any rig is opened."""
    check_origin(plan, scenario)
    chosen = choices.controller
    check_choices(scenario, plan.strategy, choices)
    fails = plan.intrusion_mm or not (plan.reached or chosen.predicts)
    if fails and not choices.force:
        missed = f"misses the target by {format_mm(plan.error_mm)} (limit {format_mm(TARGET_RADIUS_MM)}), limited by"
        why = plan.summary if plan.refusal else f"{missed} {plan.limit}"
        raise RunError(f"plan {why}{TO_INSERT_ANYWAY}")
    task = controller_tables.make_task(
        chosen, Simulator(with_controller_defaults(scenario, chosen), choices.threads), plan
    )
    return Steering(task, choices, Guard.of(task.scenario, plan), Seeds.controller(choices.seed), stream)
