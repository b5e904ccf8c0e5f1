"""Check of the sensors along the needle in air, on a virtual rig or on the rig of a rig file."""

from collections.abc import Callable, Sequence

import numpy as np

from flexneedle.errors import InputError
from flexneedle.lab.rig.preflight.start import air_margin
from flexneedle.lab.rig.sensor_check.air_run import AirRun, run_in_air
from flexneedle.lab.rig.sensor_check.motions import advance_in_air, lateral_reach, motion_time, plan_motions
from flexneedle.loop.events import Stream
from flexneedle.loop.rig import RigSource
from flexneedle.results import Plan
from flexneedle.scenario.model import Scenario


def choose_sensors(scenario: Scenario, name: str | None) -> Scenario:
    """Return the scenario with the sensors to check, all for None. Raises InputError if there is none of this name."""
    names = [one.title for one in scenario.sensor]
    if not names:
        raise InputError("the scenario has no [[sensor]]: nothing to check")
    if name is not None and name not in names:
        raise InputError(f"--sensor {name}: must be one of {', '.join(names)}")
    chosen = tuple(one for one in scenario.sensor if name in (None, one.title))
    return scenario.model_copy(update={"sensor": chosen})


def run_on(
    source: RigSource,
    scenario: Scenario,
    chosen: Scenario,
    seed: int,
    stream: Stream,
    show: Callable[[int, int], object],
) -> AirRun:
    """Carry out the motions in air for the sensors of `chosen` on a rig; show: as for `run_in_air`.

    Raises as `RigSource.open`, RunError and DriverError as `run_in_air`.
    """
    # The supervisor stops an advance at the plan's end and what may follow: here within the margin before the skin.
    scenario = scenario.with_values({"guard.past_target_mm": 0.5 * air_margin(scenario)})
    motions = plan_motions(chosen)
    with source.open(scenario, _plan_in_air(scenario, np.array(motions)), seed, stream) as rig:
        return run_in_air(scenario, rig, motions, show)


def _plan_in_air(scenario: Scenario, rows: np.ndarray) -> Plan:
    """Return the motions as a plan whose target is where the tip is farthest ahead."""
    depth, steps = scenario.setup.start_tip_x + advance_in_air(scenario), len(rows) + 1
    return Plan(
        strategy="manipulation" if scenario.setup.has_guide else "steering",
        target=(depth, 0.0, 0.0),
        seed=0,
        roll=0.0,
        controls=rows,
        tips=np.zeros((steps, 5)),
        strain_energy=np.zeros(steps),
        guide=np.zeros((steps, 2)),
        shapes=np.zeros((steps, scenario.needle.nodes, 5)),
        cost=0.0,
        terms={},
        iterations=0,
        converged=True,
        history=(),
        limit="",
        scenario=scenario,
    )


def describe_motions(scenario: Scenario) -> Sequence[str]:
    """Return lines on what will move, for its confirmation."""
    setup, reach, along = scenario.setup, lateral_reach(scenario), advance_in_air(scenario)
    part, count = ("guide", setup.moved_guide_axes) if setup.has_guide else ("base", setup.axes)
    turned = "half a turn" if setup.half_turns else f"{min(180.0, setup.max_rotation_deg or 180.0):g} deg"
    lines = [f"{part}_{axis}: {reach:.1f} mm to both sides of 0, and back" for axis in "yz"[:count] if reach]
    return [
        *lines,
        f"rotation: {turned} and back, twice",
        f"insertion: {along:.1f} mm forward, to {air_margin(scenario):.1f} mm before the skin, and back",
        *[f"{part}_y: from side to side there, more often for a slow sensor"] * (reach > 0.0),
        f"All of this in about {motion_time(scenario, plan_motions(scenario)):.0f} s.",
        "Only with the needle in air, free by these distances.",
    ]
