"""`flexneedle insert`: plan an insertion and execute it in closed loop."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from flexneedle.arguments import expand_home
from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import (
    add_run_arguments,
    add_strategy,
    choose_scenario,
    compile_first,
    print_json,
    print_problems,
    run_name,
)
from flexneedle.cli.insertion_report import report
from flexneedle.cli.progress import print_note
from flexneedle.cli.values import seed
from flexneedle.errors import FlexneedleError, StoppedError, one_line

if TYPE_CHECKING:
    from flexneedle.cli.progress import Progress
    from flexneedle.loop.choices import Choices
    from flexneedle.loop.events import Gate
    from flexneedle.loop.rig import RigSource
    from flexneedle.planning.events import Event, Listener
    from flexneedle.record.folder import Folder
    from flexneedle.results import Insertion, Period
    from flexneedle.scenario.model import Scenario


class Connection:
    """Rig and listeners of the command's insertion: the virtual rig of `--phantom` and `--tracker`.

    Another class, made from the arguments, can be set as the default of `connection` in the command's parser.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        from flexneedle.loop.virtual import SCENARIO_TRACKER, VirtualRig
        from flexneedle.phantom.plants import DEFAULT_PLANT

        self.args = args
        self.source: RigSource = VirtualRig(args.phantom or DEFAULT_PLANT, args.tracker or SCENARIO_TRACKER)

    def with_registration(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the registration of the tracker."""
        if self.args.registration is None:
            return scenario
        from flexneedle.scenario.files import load_registration

        return load_registration(self.args.registration, scenario)

    def start(self, stack: ExitStack, scenario: Scenario) -> Scenario:
        """Connect what must be connected before planning, until the stack closes; return the scenario to plan for."""
        return scenario

    def add_record(self, folder: Folder) -> None:
        """Add the record of the connection to `run.json`."""

    def listeners(self, progress: Progress) -> tuple[Listener, ...]:
        """Return further listeners, called after the progress."""
        return ()

    def gate(self, progress: Progress, scenario: Scenario) -> Gate | None:
        """Return the gate of the insertion."""
        return None

    def end(self) -> None:
        """Print how the user withdraws a needle that has moved."""


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
    parser.set_defaults(connection=Connection)
    add_run_arguments(parser)
    add_strategy(parser, "manipulation moves guide and bevel, steering only the bevel")
    parser.add_argument(
        "--plan-seed",
        type=seed,
        metavar="N",
        help="seed of the planner (default: --seed)",
    )
    _add_parts(parser)
    parser.add_argument("--list", action="store_true", help="list the controllers and exit")
    parser.add_argument(
        "--force",
        action="store_true",
        help="insert even if the plan misses by more than 1 mm, and do not hold for control.miss_limit_mm",
    )


def _add_parts(parser: argparse.ArgumentParser) -> None:
    """Add controller, plant and tracker."""
    parser.add_argument(
        "--controller",
        metavar="NAME",
        help="controller: name from --list or module:NAME (default: adaptive-mpc)",
    )
    parser.add_argument(
        "--phantom",
        metavar="KIND",
        help="plant: exact (finer, with imperfections), model (the controller's, with other parameters) or "
        "module:NAME (default: exact)",
    )
    parser.add_argument(
        "--tracker",
        metavar="NAME",
        help="tracker: scenario or module:NAME (default: scenario)",
    )
    parser.add_argument(
        "--registration",
        type=expand_home,
        metavar="FILE",
        help="registration of the tracker to the stage, written by em register",
    )


def _insert(args: argparse.Namespace) -> int:
    from flexneedle.control.controllers import DEFAULT
    from flexneedle.loop.choices import Choices
    from flexneedle.loop.insertions import check_choices
    from flexneedle.record.folder import Folder
    from flexneedle.simulator.zones import zones_of

    if args.list:
        return _list()
    with ExitStack() as stack:
        connection: Connection = args.connection(args)
        choices = Choices.of(args.seed, args.controller or DEFAULT, connection.source, force=args.force)
        with _print_refusal(args, choices):
            scenario = connection.with_registration(choose_scenario(args, choices.controller))
        with _print_refusal(args, choices, scenario):
            check_choices(scenario, args.strategy, choices)
            zones_of(scenario)  # a file that cannot be used leaves no folder
            if scenario.zone and not choices.controller.avoids_zones:
                print_note(
                    f"{choices.controller.name} does not avoid zones: only the guard holds the needle before one"
                )
            if scenario.sensor and not choices.controller.fuses and not scenario.control.essential_points:
                print_note(
                    f"{choices.controller.name} does not use sensors along the needle: they are recorded only"
                )
            scenario = connection.start(stack, scenario)
            compile_first(scenario.setup.axes)
            folder = Folder.claim(args.out, run_name(args), "insertion", scenario, args.seed)
        with print_problems(folder):
            try:
                with _print_refusal(args, choices, scenario, folder):
                    insertion = _execute(args, folder, scenario, choices, connection)
            except FlexneedleError:
                if (folder.values["result"] or {}).get("outcome") == "failed":
                    connection.end()
                raise
            status = report(scenario, insertion, args.json, folder.path)
            if insertion.periods:
                connection.end()
    return status or int(bool(folder.problems))


def _execute(
    args: argparse.Namespace, folder: Folder, scenario: Scenario, choices: Choices, connection: Connection
) -> Insertion:
    from flexneedle.cli.progress import Progress
    from flexneedle.record.recording import record_insertion
    from flexneedle.results import Outcome

    connection.add_record(folder)
    with Progress() as progress:
        insertion = record_insertion(
            folder,
            scenario,
            args.strategy,
            choices,
            plan_seed=args.plan_seed,
            listeners=(_InsertProgress(progress, scenario), *connection.listeners(progress)),
            gate=connection.gate(progress, scenario),
        )
        if insertion.outcome is Outcome.DONE:
            progress.finish("Inserting")
    return insertion


@contextmanager
def _print_refusal(
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
        raise


def _refusal(
    folder: Folder | None, target: Sequence[float] | None, choices: Choices, reason: str
) -> dict[str, Any]:
    """Return the object of an insertion that ended with an error: the recorded result, or one without a plan."""
    from flexneedle.record.results import NO_TIMING, refused_result

    run_dir = None if folder is None else str(folder.path)
    if folder is not None and folder.values["result"] is not None:
        timing = {key: folder.timing[key] for key in NO_TIMING}
        return {**folder.values["result"], "run_dir": run_dir, "timing": timing}
    parts: dict[str, Any] = {"phantom": "", "dry_run": False} | choices.parts
    names = {name: parts[name] for name in ("controller", "phantom", "dry_run")}
    result = refused_result(target=target, reason=reason, seed=choices.seed, **names)
    return {**result, "run_dir": run_dir, "timing": NO_TIMING}


def _list() -> int:
    from flexneedle.control.controllers import CONTROLLERS, DEFAULT

    width = max(map(len, CONTROLLERS))
    for name, controller in CONTROLLERS.items():
        print(f"{name:{width}}  {controller.summary}{' (default)' if name == DEFAULT else ''}")
    return 0


class _InsertProgress:
    """Progress of planner iterations and control periods."""

    def __init__(self, progress: Progress, scenario: Scenario) -> None:
        self._progress = progress
        self._start = scenario.setup.start_tip_x
        self._travel = scenario.target.depth_mm - self._start
        self._warned = False
        self._excluded = set[str]()
        progress.begin("Planning")

    def __call__(self, event: Event) -> None:
        """Show an event."""
        from flexneedle.loop.events import PeriodEnded
        from flexneedle.planning.events import Iterated

        match event:
            case Iterated(info=info):
                note = f"best cost {info['best']:.4g}"
                self._progress.show("Planning", info["iteration"], info["iterations"], note)
            case PeriodEnded(period):
                self._show_period(period)

    def _show_period(self, period: Period) -> None:
        self._progress.finish("Planning")
        depth = period.estimate.x
        if period.warning and not self._warned:
            self._warned = True
            self._progress.print_line(f"flexneedle: warning at {depth:.1f} mm: {period.warning}")
        for state in period.sensors:
            if not state.verdict.ok and state.name not in self._excluded:
                self._excluded.add(state.name)
                line = f"sensor {state.name} excluded at {depth:.1f} mm: {state.verdict}"
                self._progress.print_line(f"flexneedle: {line}")
        done = min(max(depth - self._start, 0.0), self._travel)
        self._progress.show("Inserting", done, self._travel, f"tip at {depth:.1f} mm")
