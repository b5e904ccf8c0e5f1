"""`flexneedle plan`: plan an insertion and draw the plan."""

from __future__ import annotations

import argparse
from math import degrees, isnan
from typing import TYPE_CHECKING

from flexneedle.cli.commands import Commands, add_command
from flexneedle.cli.common import (
    add_run_arguments,
    add_strategy,
    choose_scenario,
    clearance_rows,
    compile_first,
    entry_rows,
    out_of_reach_rows,
    print_json,
    print_problems,
    print_table,
    run_name,
    target_row,
)
from flexneedle.cli.progress import print_note
from flexneedle.planning import STRATEGIES

if TYPE_CHECKING:
    from pathlib import Path

    from flexneedle.results import Plan
    from flexneedle.scenario.model import Scenario


def add_parser(commands: Commands) -> None:
    """Add the command to the parser of `flexneedle`."""
    parser = add_command(
        commands,
        "plan",
        "plan an insertion and draw the plan",
        _plan,
        "flexneedle plan phantom --target 40 1.5 --strategy both",
        "flexneedle plan mine.toml --entries",
    )
    add_run_arguments(parser)
    add_strategy(parser, "manipulation moves guide and bevel, steering only the bevel", "both")
    parser.add_argument(
        "--entries",
        action="store_true",
        help="instead of a plan: a map of the free entry points with clearance, load and tolerance, without motion of "
        "the guide",
    )


def _plan(args: argparse.Namespace) -> int:
    if args.entries:
        from flexneedle.cli.entries import map_entries

        return map_entries(args)
    from flexneedle.cli.progress import Progress
    from flexneedle.planning.events import Event, Iterated
    from flexneedle.record.folder import Folder
    from flexneedle.record.plans import record_plans
    from flexneedle.simulator.zones import target_intrusion

    scenario = choose_scenario(args)
    compile_first(scenario.setup.axes, phantoms=bool(scenario.zone))
    if problem := target_intrusion(scenario):
        print_note(problem)
        return 1
    strategies = STRATEGIES if args.strategy == "both" else (args.strategy,)
    folder = Folder.claim(args.out, run_name(args), "plan", scenario, args.seed)
    with print_problems(folder), Progress() as progress:

        def show(event: Event) -> None:
            if isinstance(event, Iterated):
                info, note = event.info, f"best cost {event.info['best']:.4g}"
                progress.show(f"Planning ({event.strategy})", info["iteration"], info["iterations"], note)

        plans = record_plans(folder, scenario, strategies, args.seed, [show])
    _report(scenario, plans, args.json, folder.path)
    return 0 if all(plan.reached for plan in plans.values()) else 1


def _report(scenario: Scenario, plans: dict[str, Plan], as_json: bool, folder: Path) -> None:
    from flexneedle.record.results import plan_result, plan_timing

    if as_json:
        results = {name: {**plan_result(plan), "timing": plan_timing(plan)} for name, plan in plans.items()}
        print_json(results if len(results) > 1 else next(iter(results.values())))
        return
    title = "\n".join(f"Plan ({name}) {plan.summary}" for name, plan in plans.items())
    columns = [_rows(scenario, plan) for plan in plans.values()]
    names = dict.fromkeys(name for column in columns for name in column)
    rows = [(name, *(column.get(name, "") for column in columns)) for name in names]
    print_table(title, ("", *(plans if len(plans) > 1 else ("",))), rows)
    print(f"Record and figures: {folder}")


def _rows(scenario: Scenario, plan: Plan) -> dict[str, str]:
    from flexneedle.results import format_mm

    angles = ", ".join(f"{degrees(angle):+.2f}°" for angle in plan.entry_angles[: scenario.setup.axes])
    return {
        **dict([target_row(scenario, plan.target), *entry_rows(scenario, plan)]),
        "planned tip to target": format_mm(plan.error_mm),
        f"entry angle{'s' if scenario.setup.axes > 1 else ''}": "none" if isnan(plan.entry_angle) else angles,
        **clearance_rows(scenario, "least clearance", plan.least_clearance_mm, plan.shapes),
        **out_of_reach_rows(scenario),
        **plan.invasiveness.rows(),
        "cost (mm)": f"{plan.cost:.3g}",
        **{f"  {name}": f"{value:.3g}" for name, value in plan.terms.items()},
        "iterations": f"{plan.iterations}, {'converged' if plan.converged else 'not converged'}",
        "planning time": f"{plan.seconds:.2f} s",
    }
