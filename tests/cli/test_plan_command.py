"""`flexneedle plan`: results, records, exit status."""

import json

import pytest

from commands import names, run
from flexneedle.invasiveness import format_number

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")
STRATEGIES = ("manipulation", "steering")
PLAN_KEYS = [
    *(
        "tip_mm",
        "error_mm",
        "reached",
        "limit",
        "refusal",
        "entry",
        "cost",
        "terms",
        "flips",
        "strain_energy_mj",
    ),
    *(
        "peak_energy_uj",
        "mean_energy_uj",
        "end_energy_uj",
        "least_stretch",
        "guide_travel_mm",
        "energy_scale_uj",
    ),
    *("iterations", "converged", "seed", "timing"),
]


def test_plan_writes_a_record_and_a_figure(engine, capsys, in_tmp):
    engine()
    status, out, _ = run(capsys, "plan", "--out", "here")
    assert status == 0
    assert names(in_tmp / "here") == ["plan.png", "plan.svg", "run.json"]
    assert out.startswith("Plan (manipulation) reaches the target to 0.010 mm\n")
    result = json.loads((in_tmp / "here/run.json").read_text())["result"]["manipulation"]
    peak, mean, end = (format_number(result[f"{of}_energy_uj"]) for of in ("peak", "mean", "end"))
    assert f"{peak}, {mean}, {end} µJ" in out
    assert run(capsys, "view", "here")[:2] == (0, "here/plan.png\nhere/plan.svg\n")


def test_plan_json_is_one_object_or_one_by_strategy(engine, capsys):
    engine()
    status, out, _ = run(capsys, "plan", "--json")
    assert (status, list(json.loads(out))) == (0, PLAN_KEYS)
    both = json.loads(run(capsys, "plan", "--strategy", "both", "--json")[1])
    assert {name: list(result) for name, result in both.items()} == dict.fromkeys(STRATEGIES, PLAN_KEYS)


def test_a_plan_that_misses_names_the_limit_and_fails(engine, capsys):
    engine(plan_miss=2.5)
    status, out, _ = run(capsys, "plan")
    assert status == 1
    assert "MISSES the target: best distance 2.510 mm" in out
    assert "limited by setup.max_guide_travel_mm" in out
