"""`flexneedle scenario`: list, show and check scenarios."""

from __future__ import annotations

import argparse
import warnings
from typing import TYPE_CHECKING

from flexneedle.console.common import with_examples

if TYPE_CHECKING:
    from flexneedle.scenario.model import Scenario


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser(
        "scenario",
        help="list, show and check scenarios",
        **with_examples(
            "flexneedle scenario show phantom > mine.toml",
            "flexneedle scenario check mine.toml",
        ),
    )
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    for add in (_add_list, _add_show, _add_check, _add_schema):
        add(actions)


def _add_list(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = actions.add_parser(
        "list",
        help="list the presets",
        **with_examples(
            "flexneedle scenario list",
            "flexneedle scenario list | grep -i tissue",
        ),
    )
    parser.set_defaults(handler=_list)


def _add_show(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = actions.add_parser(
        "show",
        help="print a scenario with all its defaults, as TOML",
        **with_examples(
            "flexneedle scenario show phantom > mine.toml",
            "flexneedle scenario show world:100012:perfect",
        ),
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="preset name, world:NUMBER or path")
    _add_controller(parser)
    parser.set_defaults(handler=_show)


def _add_check(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = actions.add_parser(
        "check",
        help="check a scenario: one line for each problem, exit status 2",
        description="Check a scenario. One line on stderr for each problem, exit status 2. A warning, exit status 0, "
        "for each value that is not used, has been renamed, or is an order of magnitude outside the usual range.",
        **with_examples(
            "flexneedle scenario check mine.toml --strict",
            "flexneedle scenario check mine.toml --controller follow_path:METHOD",
        ),
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="path, preset name or world:NUMBER")
    _add_controller(parser)
    parser.add_argument("--strict", action="store_true", help="exit status 2 for warnings too")
    parser.set_defaults(handler=_check)


def _add_schema(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = actions.add_parser(
        "schema",
        help="print the JSON schema of scenario files",
        **with_examples(
            "flexneedle scenario schema > scenario.schema.json",
            "flexneedle scenario schema | python -m json.tool | less",
        ),
    )
    parser.set_defaults(handler=_schema)


def _add_controller(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--controller",
        action="append",
        default=[],
        metavar="module:METHOD",
        help="your own controller, whose table the scenario may contain; repeatable",
    )


def _list(_args: argparse.Namespace) -> int:
    from flexneedle.scenario.files import load_scenario
    from flexneedle.scenario.preset import PRESETS

    for name in PRESETS.names():
        print(f"{name:12} {load_scenario(name).name}")
    return 0


def _show(args: argparse.Namespace) -> int:
    from flexneedle.scenario.files import dump_scenario

    print(dump_scenario(_checked(args)), end="")
    return 0


def _check(args: argparse.Namespace) -> int:
    from flexneedle.errors import ScenarioWarning
    from flexneedle.scenario.plausible import doubts

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ScenarioWarning)
        scenario = _checked(args)
        for line in doubts(scenario):
            warnings.warn(f"{args.scenario}: {line}", ScenarioWarning, stacklevel=1)
    for warning in caught:
        warnings.warn(warning.message, warning.category, stacklevel=1)
    if caught and args.strict:
        return 2
    print(f"{args.scenario}: ok, {scenario.name}")
    return 0


def _checked(args: argparse.Namespace) -> Scenario:
    """Return the scenario with all defaults, including those of the controllers."""
    from flexneedle.control.methods import checked
    from flexneedle.rig.parts import controller_of
    from flexneedle.scenario.files import load_scenario

    own = [controller_of(name)[1] for name in args.controller]
    return checked(load_scenario(args.scenario), *own, source=args.scenario)


def _schema(_args: argparse.Namespace) -> int:
    import json

    from flexneedle.control.methods import METHODS
    from flexneedle.control.tables import typed_scenario

    schema = typed_scenario(tuple(METHODS.values())).model_json_schema()
    print(json.dumps(schema, indent=2, ensure_ascii=False))
    return 0
