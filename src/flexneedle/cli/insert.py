"""`flexneedle insert`: plan an insertion and execute it in closed loop."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import (
    ARMS,
    add_run_arguments,
    add_strategy,
    chosen_scenario,
    compile_first,
    confirm_motions,
    print_json,
    problems_printed,
    require_terminal,
    run_name,
    with_target,
)
from flexneedle.cli.inserted import print_still_in, report
from flexneedle.cli.values import seed
from flexneedle.errors import FlexneedleError, InputError, StoppedError, one_line
from flexneedle.interrupts import SIGNALS

if TYPE_CHECKING:
    from flexneedle.cli.progress import Progress
    from flexneedle.lab.rig.rig_file import RigFile, RosSettings
    from flexneedle.lab.rig.supervisor.client import Supervisor
    from flexneedle.lab.ros.bridge import Bridge
    from flexneedle.record.folder import Folder
    from flexneedle.record.recording import Choices
    from flexneedle.scenario.model import Scenario
    from flexneedle.types import Insertion, Period


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "insert",
        "plan an insertion and execute it in closed loop on the virtual phantom or on a rig",
        _insert,
        "flexneedle insert phantom --target 35 -5 --seed 3 --controller ce-mpc --json",
        "flexneedle insert phantom --rig rig.toml --dry-run",
    )
    add_run_arguments(parser)
    add_strategy(parser, "planning strategy: manipulation moves guide and bevel, steering only the bevel")
    parser.add_argument(
        "--plan-seed",
        type=seed,
        metavar="N",
        help="seed of the planner (default: --seed)",
    )
    _add_parts(parser)
    _add_rig(parser)
    parser.add_argument("--list", action="store_true", help="list the controllers and exit")
    parser.add_argument(
        "--force",
        action="store_true",
        help="insert even if the plan misses the target by more than 1 mm, and do not hold if the predicted miss "
        "exceeds control.miss_limit_mm",
    )


def _add_parts(parser: argparse.ArgumentParser) -> None:
    """Controller, plant and tracker."""
    parser.add_argument(
        "--controller",
        metavar="NAME",
        help="controller: a name from --list, or module:METHOD for your own (default: adaptive-mpc)",
    )
    parser.add_argument(
        "--phantom",
        metavar="KIND",
        help="plant: exact, a separate finer formulation with the imperfections of a rig; model, the controller's "
        "formulation with other parameters; or module:NAME for your own (default: exact)",
    )
    parser.add_argument(
        "--tracker",
        metavar="NAME",
        help="tracker: scenario for that of the scenario, or module:NAME for your own (default: scenario)",
    )
    parser.add_argument(
        "--registration",
        type=Path,
        metavar="FILE",
        help="registration of the tracker to the stage, written by em register",
    )


def _add_rig(parser: argparse.ArgumentParser) -> None:
    """The rig, and the connection to ROS."""
    parser.add_argument(
        "--rig",
        metavar="FILE",
        help="rig file (its path, or emulated for the one of the package), on whose motors and tracker the plan is "
        "executed, from where the motors are (default: the virtual phantom)",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="with --rig: read motors and tracker, go through all motions, and send none; the needle is the virtual "
        "phantom's",
    )
    parser.add_argument(
        "--ros",
        metavar="PROFILE",
        help="publish an insertion without --rig to ROS 2, and let its topic stop it: name or path of a profile of "
        "topics (with --rig: section [ros] of the rig file)",
    )
    parser.add_argument("--yes", action="store_true", help="with --rig: insert without a confirmation")


def _insert(args: argparse.Namespace) -> int:
    from flexneedle.record.folder import Folder
    from flexneedle.record.recording import check_choices

    if args.list:
        return _list()
    choices = _choices(args)
    with ExitStack() as stack:
        if choices.rig is not None:
            _interrupted_by_signals(stack)
        with _refusal_printed(args, choices):
            scenario = _scenario(args, choices)
        with _refusal_printed(args, choices, scenario):
            check_choices(scenario, choices)
            bridge = _bridge(args, choices, stack)
            if bridge is not None and bridge.settings.target:
                scenario = with_target(scenario, bridge.await_target())
            if _asks(args, choices):
                require_terminal()  # before the time of planning is spent
            compile_first(scenario.setup.axes)
            folder = Folder.claim(args.out, run_name(args), "insertion", scenario, args.seed)
        with problems_printed(folder):
            with _refusal_printed(args, choices, scenario, folder):
                insertion = _execute(args, folder, scenario, choices, bridge)
            status = report(scenario, insertion, args.json, folder.path)
            if choices.moves and insertion.periods:
                print_still_in(args.rig)
    return status or int(bool(folder.problems))


def _bridge(args: argparse.Namespace, choices: Choices, stack: ExitStack) -> Bridge | None:
    """The connection to ROS of --ros or of the rig file; None without one. Raises InputError for a second target."""
    settings = _ros(args, choices)
    if settings is None:
        return None
    if settings.target and args.target is not None:
        raise InputError("--target: not with target = true in [ros] of the rig file, which takes it from ROS")
    from flexneedle.lab.ros.bridge import Bridge

    return stack.enter_context(Bridge(settings, partial(print, file=sys.stderr, flush=True)))


def _ros(args: argparse.Namespace, choices: Choices) -> RosSettings | None:
    """The settings of --ros or of the rig file. Raises InputError for both, RigError for a name that is none."""
    from flexneedle.lab.rig.rig_file import RosSettings, check_settings

    if choices.rig is None:
        return None if args.ros is None else check_settings(RosSettings, {"profile": args.ros})
    if args.ros is not None:
        raise InputError("--ros: not with --rig, whose file has a section [ros] for it")
    return choices.rig.ros


def _scenario(args: argparse.Namespace, choices: Choices) -> Scenario:
    from flexneedle.loop.parts import own_controllers
    from flexneedle.scenario.files import load_registration

    rig, scenario = choices.rig, chosen_scenario(args, *own_controllers([choices.controller]))
    if args.registration is not None:
        if rig is not None and rig.registration is not None:
            raise InputError(
                "--registration: not with a rig whose file has a section [registration]: remove one"
            )
        return load_registration(args.registration, scenario)
    if rig is None or choices.dry_run:
        return scenario
    from flexneedle.lab.rig.supervised import registered

    return registered(rig, scenario)


def _execute(
    args: argparse.Namespace,
    folder: Folder,
    scenario: Scenario,
    choices: Choices,
    bridge: Bridge | None,
) -> Insertion:
    from flexneedle.cli.progress import Progress
    from flexneedle.lab.rig.supervised import Watchers
    from flexneedle.record.recording import record_insertion
    from flexneedle.types import Outcome

    with Progress() as progress:
        show = _InsertProgress(progress, scenario)
        if bridge is not None:
            bridge.show = progress.print_line
        question = "Insert?" if _asks(args, choices) else ""

        def confirm(supervisor: Supervisor) -> None:
            supervisor.take_signals()
            if choices.moves:
                _confirm(progress, scenario, supervisor, question)

        insertion = record_insertion(
            folder,
            scenario,
            choices,
            on_iteration=show.iteration,
            on_period=show.period,
            bridge=bridge,
            watchers=Watchers(confirm=confirm),
        )
        if insertion.outcome is Outcome.DONE:
            progress.finish("Inserting")
    return insertion


@contextmanager
def _refusal_printed(
    args: argparse.Namespace,
    choices: Choices,
    scenario: Scenario | None = None,
    folder: Folder | None = None,
) -> Iterator[None]:
    """With --json, print the object of an insertion that is refused or fails; the error is re-raised."""
    try:
        yield
    except StoppedError:  # like Ctrl-C: no result
        raise
    except FlexneedleError as error:
        if args.json:
            target = args.target if scenario is None else scenario.target.position
            print_json(_refusal(folder, target, choices, one_line(error)))
        result = folder and folder.values["result"]
        if choices.moves and result and result["outcome"] == "failed":
            print_still_in(args.rig)
        raise


def _refusal(
    folder: Folder | None, target: Sequence[float] | None, choices: Choices, reason: str
) -> dict[str, Any]:
    """The object of an insertion that ended with an error: the recorded result, or one without a plan."""
    from flexneedle.record.results import NO_TIMING, refused_result

    run_dir = None if folder is None else str(folder.path)
    if folder is not None and folder.values["result"] is not None:
        timing = {key: folder.timing[key] for key in NO_TIMING}
        return {**folder.values["result"], "run_dir": run_dir, "timing": timing}
    names = {"controller": choices.controller, "phantom": choices.phantom}
    result = refused_result(target=target, reason=reason, seed=choices.seed, dry_run=choices.dry_run, **names)
    return {**result, "run_dir": run_dir, "timing": NO_TIMING}


def _choices(args: argparse.Namespace) -> Choices:
    from flexneedle.record.recording import Choices

    chosen = {"controller": args.controller, "phantom": args.phantom, "tracker": args.tracker}
    named = {name: value for name, value in chosen.items() if value is not None}
    rig = _rig(args, named)
    made = Choices(args.seed, args.strategy, args.plan_seed, force=args.force, **named)
    return replace(made, rig=rig, dry_run=args.dry_run)


def _rig(args: argparse.Namespace, named: Mapping[str, str]) -> RigFile | None:
    """The rig of --rig. Raises InputError for options that contradict each other."""
    if args.rig is None:
        if args.dry_run:
            raise InputError("--dry-run: needs --rig FILE; without a rig every insertion is virtual")
        return None
    if virtual := [f"--{name}" for name in ("phantom", "tracker") if name in named]:
        raise InputError(
            f"{' and '.join(virtual)}: not with --rig, which has a needle and a tracker of its own"
        )
    from flexneedle.lab.rig.rig_file import load_rig

    return load_rig(args.rig)


def _asks(args: argparse.Namespace, choices: Choices) -> bool:
    """Whether motions are confirmed on the terminal: those of motors, unless --yes is given or ROS arms the rig."""
    ros = None if choices.rig is None else choices.rig.ros
    return choices.moves and not (args.yes or (ros is not None and ros.arm))


def _interrupted_by_signals(stack: ExitStack) -> None:
    """Have SIGTERM and SIGHUP act as Ctrl-C until the stack closes: an insertion on a rig completes its record."""
    for number in SIGNALS:
        stack.callback(signal.signal, number, signal.signal(number, signal.default_int_handler))


def _confirm(progress: Progress, scenario: Scenario, supervisor: Supervisor, question: str) -> None:
    """Print where the axes are, and ask before motors move; "": do not ask.

    Raises RunError for any answer but yes.
    """
    from flexneedle.lab.rig.start import announced

    with progress.paused():
        confirm_motions([*announced(supervisor.rig, scenario, supervisor.positions), ARMS], question)


def _list() -> int:
    from flexneedle.control.controllers import CONTROLLERS, DEFAULT

    width = max(map(len, CONTROLLERS))
    for name, method in CONTROLLERS.items():
        print(f"{name:{width}}  {method.summary}{' (default)' if name == DEFAULT else ''}")
    return 0


class _InsertProgress:
    """Progress of planner iterations and control periods."""

    def __init__(self, progress: Progress, scenario: Scenario) -> None:
        self._progress = progress
        self._start = scenario.setup.start_tip_x
        self._travel = scenario.target.depth_mm - self._start
        self._warned = False
        progress.begin("Planning")

    def iteration(self, _strategy: str, info: dict[str, Any]) -> None:
        note = f"best cost {info['best']:.4g}"
        self._progress.show("Planning", info["iteration"], info["iterations"], note)

    def period(self, period: Period) -> None:
        self._progress.finish("Planning")
        depth = period.estimate.x
        if period.warning and not self._warned:
            self._warned = True
            self._progress.print_line(f"flexneedle: warning at {depth:.1f} mm: {period.warning}")
        done = min(max(depth - self._start, 0.0), self._travel)
        self._progress.show("Inserting", done, self._travel, f"tip at {depth:.1f} mm")
