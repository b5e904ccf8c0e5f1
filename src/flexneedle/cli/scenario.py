"""`flexneedle scenario`: list, show and check scenarios."""

from __future__ import annotations

import argparse
import warnings
from typing import TYPE_CHECKING

from flexneedle.cli.commands import Commands, add_command, add_group

if TYPE_CHECKING:
    from flexneedle.scenario.model import Scenario


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    add_group(
        commands,
        "scenario",
        "list, show and check scenarios",
        (_add_list, _add_show, _add_check, _add_schema),
        "flexneedle scenario show phantom > mine.toml",
        "flexneedle scenario check mine.toml",
    )


def _add_list(commands: Commands) -> None:
    add_command(
        commands,
        "list",
        "list the presets",
        _list,
        "flexneedle scenario list",
        "flexneedle scenario list | grep -i tissue",
    )


def _add_show(commands: Commands) -> None:
    parser = add_command(
        commands,
        "show",
        "print a scenario with all its defaults, as TOML",
        _show,
        "flexneedle scenario show phantom > mine.toml",
        "flexneedle scenario show wide:100012:perfect",
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="preset name, wide:NUMBER, world:NUMBER or path")
    _add_controller(parser)


def _add_check(commands: Commands) -> None:
    parser = add_command(
        commands,
        "check",
        "check a scenario: one line for each problem, exit status 2",
        _check,
        "flexneedle scenario check mine.toml --strict",
        "flexneedle scenario check mine.toml --controller follow_path:CONTROLLER",
        about="Check a scenario. Prints one line per problem (exit status 2) and a warning for each unused "
        "or implausible value, and for each file of a zone that cannot be used (exit status 0).",
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="path, preset name, wide:NUMBER or world:NUMBER")
    _add_controller(parser)
    parser.add_argument("--strict", action="store_true", help="exit status 2 for warnings too")


def _add_schema(commands: Commands) -> None:
    add_command(
        commands,
        "schema",
        "print the JSON schema of scenario files",
        _schema,
        "flexneedle scenario schema > scenario.schema.json",
        "flexneedle scenario schema | python -m json.tool | less",
    )


def _add_controller(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--controller",
        action="append",
        default=[],
        metavar="module:NAME",
        help="custom controller whose table the scenario may contain; repeatable",
    )


def _list(_args: argparse.Namespace) -> int:
    from flexneedle.scenario.files import load_scenario
    from flexneedle.scenario.library import PRESETS

    for name in PRESETS.names():
        print(f"{name:12} {load_scenario(name).name}")
    return 0


def _show(args: argparse.Namespace) -> int:
    from flexneedle.scenario.files import dump_scenario

    print(dump_scenario(_load_complete(args)), end="")
    return 0


def _check(args: argparse.Namespace) -> int:
    from flexneedle.errors import ScenarioWarning
    from flexneedle.scenario.plausible import find_doubts
    from flexneedle.simulator.zone_doubts import find_zone_doubts

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ScenarioWarning)
        scenario = _load_complete(args)
        for line in [*find_doubts(scenario), *find_zone_doubts(scenario)]:
            warnings.warn(f"{args.scenario}: {line}", ScenarioWarning, stacklevel=1)
    for warning in caught:
        warnings.warn(warning.message, warning.category, stacklevel=1)
    if caught and args.strict:
        return 2
    print(f"{args.scenario}: ok, {scenario.name}")
    return 0


def _load_complete(args: argparse.Namespace) -> Scenario:
    """Return the scenario with all defaults, including the settings of the controllers."""
    from flexneedle.control.controllers import check_tables, find_controller
    from flexneedle.scenario.files import load_scenario

    own = [find_controller(name)[1] for name in args.controller]
    return check_tables(load_scenario(args.scenario), *own, source=args.scenario)


def _schema(_args: argparse.Namespace) -> int:
    import json

    from flexneedle.control.controller_tables import scenario_class
    from flexneedle.control.controllers import CONTROLLERS

    schema = scenario_class(tuple(CONTROLLERS.values())).model_json_schema()
    print(json.dumps(schema, indent=2, ensure_ascii=False))
    return 0
