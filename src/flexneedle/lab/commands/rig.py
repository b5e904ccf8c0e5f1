"""`flexneedle rig`: check a rig, and move its axes one by one."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from flexneedle.cli.commands import Commands, add_command, add_group
from flexneedle.cli.common import add_strategy, print_json, print_table
from flexneedle.cli.progress import print_line, print_note
from flexneedle.cli.values import finite, positive
from flexneedle.lab.commands.confirmation import ARMS, confirm_motions
from flexneedle.lab.commands.rig_parts import add_rig, add_yes, arm, print_findings, stop_on_error
from flexneedle.lab.commands.rig_start import add_ready, add_test

if TYPE_CHECKING:
    from flexneedle.lab.rig.preflight.moves import AxisHoming, AxisMove
    from flexneedle.lab.rig.preflight.rig_check import IntendedInsertion
    from flexneedle.lab.rig.rig_file import RigFile
    from flexneedle.lab.rig.supervisor.client import SupervisorClient

_SECONDS = 2.0
_FALLS = "A vertical axis falls unless something holds it: support it first."
_NEGATIVE = re.compile(r"^-[\d.]")


def open_supervisor(rig: RigFile) -> SupervisorClient:
    """Return the supervisor of a rig; leaving the context stops all axes and ends it."""
    from flexneedle.lab.rig.supervisor.client import SupervisorClient

    return SupervisorClient.of_operator(rig)


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    add_group(
        commands,
        "rig",
        "check the motors and the tracker of a rig, and move its axes",
        (_add_show, _add_check, add_test, _add_jog, _add_home, add_ready, _add_retract, _add_off),
        "flexneedle rig check rig.toml --scenario phantom",
        "flexneedle rig jog rig.toml insertion -5mm",
    )


def _add_show(commands: Commands) -> None:
    parser = add_command(
        commands,
        "show",
        "print a rig file with its units, defaults and derived limits",
        _show,
        "flexneedle rig show rig.toml",
        "flexneedle rig show emulated",
        about="Print the values of a rig file with their units, the limits that follow from them, and the devices. "
        "Connects to nothing.",
    )
    add_rig(parser)


def _add_check(commands: Commands) -> None:
    parser = add_command(
        commands,
        "check",
        "compare a rig with its file, without motion",
        _check,
        "flexneedle rig check rig.toml",
        "flexneedle rig check rig.toml --scenario phantom --json",
        about="Connect to each device and compare it with the rig file: motors, positions, limit switches, "
        "tracker frames and sensors, ROS publishers. Moves, powers, publishes and changes nothing. "
        "Exit status 1 if there is a problem.",
    )
    add_rig(parser)
    parser.add_argument(
        "--scenario",
        metavar="S",
        help="also check that the rig can do what this scenario needs (name or path)",
    )
    add_strategy(parser, "strategy of the scenario's plan; steering moves neither guide nor base sideways")
    parser.add_argument(
        "--seconds",
        type=positive,
        default=_SECONDS,
        metavar="S",
        help=f"time for which frames of the tracker and messages are counted (default: {_SECONDS:g})",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")


def _add_jog(commands: Commands) -> None:
    parser = add_command(
        commands,
        "jog",
        "move one axis by a distance or to a position",
        _jog,
        "flexneedle rig jog rig.toml insertion -5mm",
        "flexneedle rig jog rig.toml rotation --to 0deg --speed 90",
        about="Move one axis by a distance, or to a position, within its soft limits. Asks for confirmation; Ctrl-C "
        "stops.",
    )
    add_rig(parser)
    parser.add_argument(
        "axis", metavar="AXIS", help="axis of the rig file, such as insertion, rotation or guide_y"
    )
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument(
        "distance", metavar="DISTANCE", nargs="?", help="distance with its sign, such as 5, -2.5mm or 90deg"
    )
    goal.add_argument(
        "--to", metavar="POSITION", help="position in place of a distance, such as 0mm or 180deg"
    )
    _add_speed(parser, "mm/s or deg/s")
    add_yes(parser)
    # With this pattern argparse distinguishes -5mm from an option; there is no public way to set it.
    parser._negative_number_matcher = _NEGATIVE


def _add_home(commands: Commands) -> None:
    parser = add_command(
        commands,
        "home",
        "home axes",
        _home,
        "flexneedle rig home rig.toml",
        "flexneedle rig home rig.toml insertion --yes",
        about="Home axes as set by home in the rig file, one after another, insertion first. Use "
        "only without a needle in tissue. Asks for confirmation; Ctrl-C stops.",
    )
    add_rig(parser)
    parser.add_argument(
        "axes", nargs="*", metavar="AXIS", help="axes (default: all but those with an absolute encoder)"
    )
    add_yes(parser)


def _add_retract(commands: Commands) -> None:
    parser = add_command(
        commands,
        "retract",
        "withdraw the needle",
        _retract,
        "flexneedle rig retract rig.toml",
        "flexneedle rig retract rig.toml --to 10 --speed 1 --yes",
        about="Move the insertion axis backwards, within its soft limits and short of its home switch; "
        "rotation and guide rest. Asks for confirmation; Ctrl-C stops.",
    )
    add_rig(parser)
    parser.add_argument(
        "--to",
        type=finite,
        metavar="MM",
        help="final position (default: the position after rig home, or without a limit switch the lowest "
        "of range_mm)",
    )
    _add_speed(parser, "mm/s")
    add_yes(parser)


def _add_speed(parser: argparse.ArgumentParser, unit: str) -> None:
    parser.add_argument(
        "--speed",
        type=positive,
        metavar="V",
        help=f"largest speed, {unit} (default: a fifth of the axis's)",
    )


def _add_off(commands: Commands) -> None:
    parser = add_command(
        commands,
        "off",
        "switch the motors off",
        _off,
        "flexneedle rig off rig.toml",
        "flexneedle rig off rig.toml --yes",
        about="Stop all axes and switch their motors off. A vertical axis may fall. Asks for confirmation; "
        "the next motion switches the motors on.",
    )
    add_rig(parser)
    add_yes(parser, "switch off")


# Show and check


def _show(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.preflight.describe_rig import AXIS_HEADS, describe_axes, describe_devices
    from flexneedle.lab.rig.rig_file import load_rig

    rig = load_rig(args.rig)
    print_table(rig.name, ("", ""), describe_devices(rig))
    print_table("Axes", AXIS_HEADS, describe_axes(rig))
    return 0


def _check(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.devices.clock import WallClock
    from flexneedle.lab.rig.preflight.rig_check import check_rig
    from flexneedle.lab.rig.rig_file import load_rig
    from flexneedle.lab.ros.topic_check import check_ros

    rig, clock = load_rig(args.rig), WallClock()
    findings = [
        *check_rig(rig, clock, args.seconds, _load_intended(args)),
        *check_ros(rig, clock, args.seconds),
    ]
    problems = sum(1 for finding in findings if finding.problem)
    if args.json:
        lines = [
            {"part": one.part, "item": one.item, "found": one.found, "problem": one.problem or None}
            for one in findings
        ]
        print_json({"rig": rig.name, "ok": not problems, "findings": lines})
    else:
        print_findings(args.rig, findings)
    return 1 if problems else 0


def _load_intended(args: argparse.Namespace) -> IntendedInsertion | None:
    from flexneedle.lab.rig.preflight.rig_check import IntendedInsertion
    from flexneedle.scenario.files import load_scenario

    return None if args.scenario is None else IntendedInsertion(load_scenario(args.scenario), args.strategy)


# Motions


def _jog(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.devices.opening import read_positions
    from flexneedle.lab.rig.preflight.moves import find_axis, plan_jog
    from flexneedle.lab.rig.rig_file import load_rig

    rig = load_rig(args.rig)
    axis = find_axis(rig, args.axis)
    at, to = read_positions(rig)[args.axis], args.to is not None
    move = plan_jog(rig, args.axis, args.to if to else args.distance, at, args.speed, to=to)
    if move is None:
        print_note(f"{args.axis} is at {axis.to_text(at)} {axis.unit}: nothing to move")
        return 0
    bends = args.axis not in ("insertion", "rotation")
    notes = ["Only without a needle in tissue, which this bends."] if bends else []
    return _confirm_and_move(
        rig, [move], args.yes, lambda operator: operator.move_to(move.name, move.goal, move.speed), *notes
    )


def _home(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.preflight.moves import plan_homings
    from flexneedle.lab.rig.rig_file import load_rig

    rig = load_rig(args.rig)
    chosen = plan_homings(rig, args.axes)
    if not chosen:
        print_note("no axis needs homing: all have absolute encoders")
        return 0

    def home(operator: SupervisorClient) -> None:
        for number, homing in enumerate(chosen):
            if number > 0:
                arm(operator)
            operator.home(homing.name)

    return _confirm_and_move(rig, chosen, args.yes, home, "Only without a needle in tissue.")


def _retract(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.devices.opening import read_positions
    from flexneedle.lab.rig.preflight.moves import describe_withdrawn, plan_retraction
    from flexneedle.lab.rig.rig_file import load_rig

    rig = load_rig(args.rig)
    position = read_positions(rig)["insertion"]
    move = plan_retraction(rig, position, args.to, args.speed)
    if move is None:
        print_note(describe_withdrawn(rig, position))
        return 0
    return _confirm_and_move(rig, [move], args.yes, lambda operator: operator.retract(move.goal, move.speed))


def _off(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.devices.opening import read_positions
    from flexneedle.lab.rig.preflight.moves import describe_power_off
    from flexneedle.lab.rig.rig_file import load_rig

    rig = load_rig(args.rig)
    confirm_motions(
        [*describe_power_off(rig, read_positions(rig)), _FALLS], "" if args.yes else "Switch off?"
    )
    with open_supervisor(rig) as operator, stop_on_error(operator):
        operator.off()
    print_line("done")
    return 0


def _confirm_and_move(
    rig: RigFile,
    moves: Sequence[AxisMove | AxisHoming],
    yes: bool,
    command: Callable[[SupervisorClient], object],
    *notes: str,
) -> int:
    """Print the motions, command them once they are confirmed, and return the exit status."""
    from flexneedle.lab.rig.preflight.moves import AxisMove, require_start

    confirm_motions([*map(str, moves), *notes, ARMS], "" if yes else "Move?")
    with open_supervisor(rig) as operator, stop_on_error(operator):
        for move in moves:
            if isinstance(move, AxisMove):
                require_start(move, operator.positions[move.name])
        arm(operator)
        command(operator)
    print_line("done")
    return 0
