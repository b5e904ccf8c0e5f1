"""`flexneedle rig test` and `flexneedle rig ready`: motions in air that the tracker measures."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.progress import print_line, print_note
from flexneedle.lab.commands.confirmation import ARMS, confirm_motions
from flexneedle.lab.commands.rig_parts import add_rig, add_yes, arm, print_findings, stop_on_error

if TYPE_CHECKING:
    from pathlib import Path

    from flexneedle.lab.rig.preflight.axis_test import AxisRun, MotorHistory
    from flexneedle.lab.rig.preflight.moves import AxisMove
    from flexneedle.lab.rig.rig_file import RigFile
    from flexneedle.lab.rig.supervisor.client import SupervisorClient
    from flexneedle.scenario.model import Scenario
    from flexneedle.types import Floats, Point

_TIP_S = 1.0  # for which the tip is measured at rest
_IN_AIR = "Only with the needle in air, free by these distances in both directions of each axis."


def add_test(commands: Commands) -> None:
    """Add `rig test`."""
    parser = add_command(
        commands,
        "test",
        "move each axis in air, and compare it with the tracker",
        _test,
        "flexneedle rig test rig.toml --scenario phantom",
        "flexneedle rig test emulated --yes --out evidence",
        about="Move each axis there and back by a few millimetres, the rotation by half a turn, and compare the "
        "tracker: scale, sign, direction, axis, lost motion and delay, with the value that fits. Only in air. Asks for "
        "confirmation; Ctrl-C stops. Exit status 1 if there is a problem.",
    )
    add_rig(parser)
    parser.add_argument(
        "--scenario",
        metavar="S",
        help="needle and guide, by which the tip moves more or less than the guide (default: only the sign of the "
        "guide is compared)",
    )
    parser.add_argument(
        "--out",
        type=expand_home,
        metavar="DIR",
        help="folder of the evidence (default: runs/<date>-rig-test-<name>)",
    )
    add_yes(parser)


def add_ready(commands: Commands) -> None:
    """Add `rig ready`."""
    parser = add_command(
        commands,
        "ready",
        "bring all axes to the start of a scenario",
        _ready,
        "flexneedle rig ready rig.toml --scenario phantom",
        "flexneedle rig ready emulated --scenario phantom --yes",
        about="Bring the tip to the start of a scenario and the other axes to 0: first back, then rotation, guide and "
        "base, then forward. Refused with the needle in tissue. Asks for confirmation; Ctrl-C stops.",
    )
    add_rig(parser)
    parser.add_argument("--scenario", metavar="S", required=True, help="name or path of the scenario")
    add_yes(parser)


def _test(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.preflight.axis_evidence import create_evidence
    from flexneedle.lab.rig.preflight.axis_findings import share_after_probe
    from flexneedle.lab.rig.preflight.axis_test import (
        AxisRun,
        MotorHistory,
        measure_rest,
        plan_axis_test,
        run_axis_tests,
    )
    from flexneedle.lab.rig.preflight.ready import require_air
    from flexneedle.lab.rig.preflight.tip_response import air_responses
    from flexneedle.lab.rig.rig_file import load_rig
    from flexneedle.lab.rig.tracked import open_tracked

    rig, scenario, motors, runs = load_rig(args.rig), _load(args.scenario), MotorHistory(), list[AxisRun]()
    try:
        with open_tracked(rig, scenario, motors.add) as operator, stop_on_error(operator):
            rest = measure_rest(operator, _TIP_S)
            responses = air_responses(rig, scenario, float(rest.tip[0]))
            plans = plan_axis_test(rig, operator.positions, rest, responses)
            moves = [plan.move for plan in plans]
            if scenario is not None:
                farthest = max(abs(one.distance) for one in moves if one.axis.unit == "mm")
                require_air(rig, float(rest.tip[0]), farthest)
            confirm_motions([*map(str, moves), _IN_AIR, ARMS], "" if args.yes else "Move?")
            folder = create_evidence(rig, args.out)
            _start(operator, moves)
            run_axis_tests(operator, plans, partial(share_after_probe, rig, responses), runs)
    finally:  # also after a fault, once all axes are stopped
        failed = bool(runs) and _conclude(args.rig, folder, rig, scenario, responses, runs, motors)
    return 1 if failed else 0


def _conclude(
    name: str,
    folder: Path,
    rig: RigFile,
    scenario: Scenario | None,
    responses: Mapping[str, Floats],
    runs: Sequence[AxisRun],
    motors: MotorHistory,
) -> bool:
    """Write and print the findings; return whether there is a problem."""
    from flexneedle.lab.rig.preflight.axis_evidence import write_evidence
    from flexneedle.lab.rig.preflight.axis_findings import describe_motions, measure_motion
    from flexneedle.lab.rig.preflight.frame_turn import describe_frame
    from flexneedle.scenario.sections.settings import ControlSettings

    motions = {run.name: measure_motion(rig, responses, run, motors) for run in runs}
    control = ControlSettings() if scenario is None else scenario.control
    findings = [*describe_motions(rig, motions, control.stale_after_s), *describe_frame(motions)]
    write_evidence(folder, rig, runs, motors, findings)
    print_findings(name, findings)
    print_line(f"evidence: {folder}")
    return any(one.problem for one in findings)


def _ready(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.preflight.ready import plan_way_to_start
    from flexneedle.lab.rig.rig_file import load_rig
    from flexneedle.lab.rig.tracked import open_tracked
    from flexneedle.scenario.files import load_scenario

    rig, scenario = load_rig(args.rig), load_scenario(args.scenario)
    with open_tracked(rig, scenario) as operator, stop_on_error(operator):
        way = plan_way_to_start(rig, scenario, operator.positions, _measure_tip(operator))
        if not way.moves:
            print_note("the rig is at the start: nothing to move")
            return 0
        confirm_motions([*map(str, way.moves), ARMS], "" if args.yes else "Move?")
        _start(operator, (*way.back, *way.across, *way.forward[:1]))
        for move in (*way.back, *way.across):
            operator.move_to(move.name, move.goal, move.speed)
        _advance(operator, scenario, way.forward)
    print_line("done")
    return 0


def _advance(operator: SupervisorClient, scenario: Scenario, forward: Sequence[AxisMove]) -> None:
    """Carry out the motions forward; before each further one, and at the end, the tip must be where it should be."""
    from flexneedle.lab.rig.preflight.ready import check_advance

    tip = _measure_tip(operator)
    for move in forward:
        operator.move_to(move.name, move.goal, move.speed)
        tip = check_advance(operator.rig, scenario, move, tip, _measure_tip(operator))


def _measure_tip(operator: SupervisorClient) -> Point | None:
    operator.wait(_TIP_S)
    operator.read()
    tip = operator.tip(_TIP_S)
    return None if tip is None else tip.point


def _start(operator: SupervisorClient, moves: Sequence[AxisMove]) -> None:
    """Arm the rig, if no axis has left the start of its first motion."""
    from flexneedle.lab.rig.preflight.moves import require_start

    first = {move.name: move for move in reversed(moves)}
    for move in first.values():
        require_start(move, operator.positions[move.name])
    arm(operator)


def _load(name: str | None) -> Scenario | None:
    from flexneedle.scenario.files import load_scenario

    return None if name is None else load_scenario(name)
