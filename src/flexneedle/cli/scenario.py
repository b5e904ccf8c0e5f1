"""`flexneedle scenario`: list, show and check scenarios."""

from __future__ import annotations

import argparse

__all__ = ["add_parser"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = subparsers.add_parser("scenario", help="list, show and check scenarios")
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    actions.add_parser("list", help="list the presets").set_defaults(handler=_list)

    show = actions.add_parser("show", help="print a scenario with all its defaults, as TOML")
    show.add_argument("scenario", metavar="SCENARIO", help="preset name, world:NUMBER or path")
    show.set_defaults(handler=_show)

    check = actions.add_parser("check", help="check a scenario: one line for each problem, exit status 2")
    check.add_argument("scenario", metavar="SCENARIO", help="path, preset name or world:NUMBER")
    check.set_defaults(handler=_check)

    actions.add_parser("schema", help="print the JSON schema of scenario files").set_defaults(handler=_schema)


def _list(_args: argparse.Namespace) -> int:
    from flexneedle.scenario import load_scenario, preset_names

    for name in preset_names():
        print(f"{name:12} {load_scenario(name).name}")
    return 0


def _show(args: argparse.Namespace) -> int:
    from flexneedle.scenario import dump_scenario, load_scenario

    print(dump_scenario(load_scenario(args.scenario)), end="")
    return 0


def _check(args: argparse.Namespace) -> int:
    from flexneedle.scenario import load_scenario

    scenario = load_scenario(args.scenario)
    print(f"{args.scenario}: ok, {scenario.name}")
    return 0


def _schema(_args: argparse.Namespace) -> int:
    import json

    from flexneedle.scenario import Scenario

    print(json.dumps(Scenario.model_json_schema(), indent=2, ensure_ascii=False))
    return 0
