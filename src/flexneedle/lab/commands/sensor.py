"""`flexneedle sensor`: check the sensors along the needle in air."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command, add_group
from flexneedle.cli.common import add_seed, print_json
from flexneedle.cli.progress import Progress, print_line
from flexneedle.lab.commands.confirmation import ARMS, confirm_motions
from flexneedle.lab.commands.rig_parts import add_yes, print_findings
from flexneedle.loop.events import AllGates, Gate, Stream

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from flexneedle.lab.rig.sensor_check.air_fit import AirFit
    from flexneedle.lab.rig.sensor_check.air_run import AirRun
    from flexneedle.lab.rig.supervised import SupervisedRig
    from flexneedle.scenario.model import Scenario

_RESULT, _FIGURE = "check.json", "sensors"


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    add_group(
        commands,
        "sensor",
        "check the sensors along the needle",
        (_add_check,),
        "flexneedle sensor check scenario.toml",
        "flexneedle sensor check scenario.toml --rig rig.toml --out sensors",
    )


def _add_check(commands: Commands) -> None:
    parser = add_command(
        commands,
        "check",
        "compare sensors with the tracker and the model, in air",
        _check,
        "flexneedle sensor check scenario.toml",
        "flexneedle sensor check scenario.toml --rig rig.toml --sensor fbg --out sensors",
        about="Move guide, rotation and base in air, and compare each sensor with the tracker and the model: delay, "
        "gain, roll offset, offset, noise, rate and losses, with the lines that correct the files. On a rig only "
        "with the needle in air, at the start of the scenario (rig ready). Asks for confirmation; Ctrl-C stops. Exit "
        "status 1 if a value does not fit.",
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="name or path of a scenario with [[sensor]]")
    parser.add_argument(
        "--rig", metavar="FILE", help="path of a rig file, or emulated (default: virtual phantom)"
    )
    add_seed(parser, "seed of the virtual phantom and its sensors")
    parser.add_argument("--sensor", metavar="NAME", help="only this sensor (default: all of the scenario)")
    parser.add_argument(
        "--out", type=expand_home, metavar="DIR", help=f"write {_RESULT} and a figure to this folder"
    )
    parser.add_argument("--json", action="store_true", help="print the errors as one JSON object")
    add_yes(parser)


def _check(args: argparse.Namespace) -> int:
    from flexneedle.lab.rig.sensor_check.air_fit import fit_in_air
    from flexneedle.lab.rig.sensor_check.check import choose_sensors, run_on
    from flexneedle.lab.rig.sensor_check.findings import find_errors, lines_to_paste
    from flexneedle.loop.virtual import VirtualRig
    from flexneedle.scenario.files import load_scenario

    scenario, rig = load_scenario(args.scenario), None
    chosen = choose_sensors(scenario, args.sensor)
    if args.rig is None:
        with Progress() as progress:
            run = run_on(VirtualRig(), scenario, chosen, args.seed, Stream(), _shown(progress))
    else:
        from flexneedle.lab.rig.supervised import SupervisedRig

        source = SupervisedRig(args.rig)
        rig, run = source.file, _run_on_rig(args, source, scenario, chosen)
    fit = fit_in_air(chosen, run)
    errors = find_errors(fit, rig)
    lines, failed = lines_to_paste(errors), any(one.line for one in errors)
    values = {
        "scenario": scenario.name,
        "ok": not failed,
        "errors": [one.values for one in errors],
        "lines": lines,
    }
    if args.json:
        print_json(values)
    else:
        print_findings(args.scenario, [one.finding for one in errors])
        print("\n".join(lines))
    if args.out is not None:
        _write(args.out, values, fit)
    return 1 if failed else 0


def _run_on_rig(
    args: argparse.Namespace, source: SupervisedRig, scenario: Scenario, chosen: Scenario
) -> AirRun:
    """Carry out the motions on a rig, once they are confirmed."""
    from flexneedle.lab.commands.insert import interrupt_on_signals
    from flexneedle.lab.rig.sensor_check.check import run_on
    from flexneedle.lab.ros.bridge import Bridge

    source.check(scenario, "manipulation" if scenario.setup.has_guide else "steering")
    with ExitStack() as stack:
        interrupt_on_signals(stack)
        ros = source.file.ros
        bridges = () if ros is None else (stack.enter_context(Bridge(ros, print_line)),)
        progress = stack.enter_context(Progress())
        gate = AllGates(*bridges, _UserGate(chosen, progress, yes=args.yes))
        return run_on(source, scenario, chosen, args.seed, Stream(bridges, gate), _shown(progress))


def _shown(progress: Progress) -> Callable[[int, int], None]:
    """Return a function that shows the motions done, of all."""
    return lambda done, count: progress.show("Moving in air", done, count, f"{done} of {count} motions")


class _UserGate(Gate):
    """Prints the motions, and asks before motors move."""

    def __init__(self, scenario: Scenario, progress: Progress, *, yes: bool) -> None:
        self._scenario, self._progress, self._yes = scenario, progress, yes

    def confirm(self, rig: Any) -> None:
        """Ask. Raises RunError for any answer but yes."""
        from flexneedle.lab.rig.preflight.moves import describe_axes
        from flexneedle.lab.rig.sensor_check.check import describe_motions

        rig.take_signals()
        lines = [
            *describe_motions(self._scenario),
            *describe_axes(rig.rig, rig.positions),
            ARMS,
        ]
        with self._progress.pause_display():
            confirm_motions(lines, "" if self._yes else "Move?")


def _write(folder: Path, values: dict[str, Any], fit: AirFit) -> None:
    """Write result and figure. Raises InputError if the folder cannot be created."""
    from flexneedle.errors import InputError
    from flexneedle.figures.style import save
    from flexneedle.files import replace_file
    from flexneedle.lab.rig.sensor_check.picture import draw_check
    from flexneedle.record.plain import to_text

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}: choose another --out") from None
    replace_file(folder / _RESULT, to_text(values).encode())
    save(draw_check(fit), folder, _FIGURE)
