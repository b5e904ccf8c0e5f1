"""studies/front.py: the oracle knows the phantom, and the table compares with open loop on the same world."""

import csv
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import front
import oracle
from flexneedle.loop.virtual import Seeds
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ModelPlant
from flexneedle.scenario.worlds import world
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL

SMALL = ["--kind", "world", "--samples", "16", "--iterations", "3", "--workers", "1"]


@pytest.mark.long
def test_a_world_has_rows_of_controllers_and_oracle_the_same_each_time(tmp_path, capsys):
    tables, files = [], []
    for folder in (tmp_path / "first", tmp_path / "again"):
        arguments = ["--worlds", "4", "1", "--controllers", "open-loop", "adaptive-mpc", *SMALL]
        assert front.main([*arguments, "--out", str(folder)]) == 0
        tables.append(capsys.readouterr().out)
        files.append((folder / "rows.csv").read_bytes())
        assert (folder / "front.png").stat().st_size > 0
    assert tables[0] == tables[1]
    assert files[0] == files[1]
    rows = list(csv.DictReader(files[0].decode().splitlines()))
    assert [row["controller"] for row in rows] == ["open-loop", "adaptive-mpc", "oracle"]
    assert all(float(row["peak_energy_uj"]) > 0.0 for row in rows)
    cells = cells_of(tables[0])
    assert list(cells) == ["open-loop", "adaptive-mpc", "oracle"]
    assert cells["open-loop"][:5] == ["1", "1", "1", "1", "1"]
    ratio = float(rows[1]["mean_energy_uj"]) / float(rows[0]["mean_energy_uj"])
    assert float(cells["adaptive-mpc"][3]) == pytest.approx(ratio, rel=5e-3)


def cells_of(table):
    """Cells of the rows of a table by name."""
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()[2:] if line.startswith("|")]
    return {name: cells for name, *cells in rows}


def test_the_oracle_plans_on_the_true_phantom_from_its_true_start():
    """Against the model plant of the phantom, which carries the plan out."""
    drawn = draw(world(4), np.random.default_rng(Seeds.of(4).phantom))
    truth = replace(drawn, base_y=0.7, base_turn=4e-3, load=(2e-3, 0.0))
    plan = oracle.find_oracle(truth, "manipulation", 16, 3)
    plant = ModelPlant(truth, plan.roll)
    tips, energies = [plant.tip], [plant.strain_energy]
    for row in plan.controls:
        plant.step(row)
        tips.append(plant.tip)
        energies.append(plant.strain_energy)
    assert_allclose(tips, plan.tips, atol=1e-9)
    assert_allclose(energies, plan.strain_energy, atol=1e-12)
    assert plan.error_mm < 0.1


def test_without_an_error_of_the_start_the_needle_is_as_in_a_plan():
    truth = draw(world(4, "perfect"), np.random.default_rng(0))
    ours, theirs = oracle.TrueSimulator(truth, truth.scenario), Simulator(truth.scenario, 1)
    assert_allclose(ours.start(math.pi).tip, theirs.step(theirs.start(math.pi), STILL).tip, atol=1e-12)


def made(number, controller, peak, outcome="done", error=0.1):
    row = {"world": f"world:{number}", "controller": controller, "outcome": outcome, "true_error_mm": error}
    loads = {"peak_energy_uj": peak, "mean_energy_uj": 0.5 * peak, "end_energy_uj": 0.1 * peak}
    more = {
        "energy_scale_uj": 100.0,
        "guide_travel_mm": 2.0,
        "rolls": number,
        "least_stretch": 1.0 - 0.1 * number,
    }
    return front.complete(row | loads | more)


def test_energies_are_compared_on_the_same_world_where_both_are_done():
    rows = [
        *(made(k, "open-loop", peak) for k, peak in ((1, 10.0), (2, 1.0), (3, 5.0))),
        *(made(k, "ce-mpc", peak, error=0.1 * k) for k, peak in ((1, 20.0), (2, 8.0))),
        made(3, "ce-mpc", 900.0, "failed", 30.0),
        made(4, "ce-mpc", 20.0, error=0.6),
    ]
    cells = cells_of(front.table(rows, ["open-loop", "ce-mpc"]))
    assert cells["open-loop"][:5] == ["3", "3", "1", "1", "1"]
    # peaks 20, 8 and 20 µJ: twice and eight times the peak of open loop, which did not insert into world 4
    assert cells["ce-mpc"][:7] == ["4", "3", "4", "4", "4", "14.7", "0.147"]
    assert cells["ce-mpc"][7:] == ["2", "2.33", "0.6", "0.3", "0.2", "0.56", "0.6", "–"]
    assert front.list_unfinished(rows) == ["world:3, ce-mpc: failed, "]


def inserted(axes, misses, outcome="done"):
    """An insertion that ended 0.3 mm from the target in y and 0.4 mm in z, with predicted misses and deviations."""
    periods = [
        SimpleNamespace(miss=miss, miss_sd=sd, true_tip=SimpleNamespace(y=5.3, z=0.4)) for miss, sd in misses
    ]
    scenario = SimpleNamespace(setup=SimpleNamespace(axes=axes))
    return SimpleNamespace(periods=periods, outcome=outcome, target=(40.0, 5.0, 0.0), scenario=scenario)


UNKNOWN, ZERO = (math.nan, math.nan), (0.0, 0.0)


@pytest.mark.parametrize(
    ("axes", "misses", "share"),
    [
        (1, [(ZERO, 0.16), (ZERO, 0.15), (UNKNOWN, math.nan), (ZERO, 0.16)], 2 / 3),
        (2, [(ZERO, 0.21), (ZERO, 0.20), ((0.3, 0.4), 1e-9)], 2 / 3),
        (1, [(UNKNOWN, math.nan)], math.nan),
    ],
)
def test_a_decision_is_covered_if_its_interval_has_the_final_miss(axes, misses, share):
    assert front.find_coverage(inserted(axes, misses)) == pytest.approx(share, nan_ok=True)
    assert math.isnan(front.find_coverage(inserted(axes, misses, "failed")))


def test_worlds_without_the_rig_are_skipped(capsys):
    """Worlds 15 and 16 of kind `world` have no guide, of kind `wide`, the default, world 15."""
    assert front.parse(["--worlds", "14", "2"]).numbers == [14, 16]
    assert front.parse(["--kind", "world", "--worlds", "14", "2"]).numbers == [14, 17]
    assert front.parse(["--worlds", "14", "2", "--no-guided"]).numbers == [14, 15]
    assert front.parse(["--worlds", "14", "1", "--rig", "no-guide"]).numbers == [15]
    for worlds in (("-1", "5"), ("0", "0"), ("99999", "2")):
        with pytest.raises(SystemExit) as left:
            front.parse(["--worlds", *worlds])
        assert left.value.code == 2
        assert "--worlds " in capsys.readouterr().err


def test_a_refusal_and_an_error_are_rows():
    def refuse():
        raise front.RunError("plan misses")

    def fail():
        raise ValueError("no")

    assert front.attempt(refuse) == {"outcome": "refused", "reason": "plan misses"}
    assert front.attempt(fail)["outcome"] == "error"


def test_after_ctrl_c_the_rows_of_finished_worlds_are_kept(tmp_path, monkeypatch, capsys):
    def measure(job):
        if job.number == 6:
            raise KeyboardInterrupt
        return [made(job.number, "open-loop", 10.0)]

    monkeypatch.setattr(front, "measure_world", measure)
    assert front.main(["--worlds", "4", "4", *SMALL, "--out", str(tmp_path)]) == 130
    rows = csv.DictReader((tmp_path / "rows.csv").read_text(encoding="utf-8").splitlines())
    assert [row["world"] for row in rows] == ["world:4", "world:5"]
    shown = capsys.readouterr()
    assert cells_of(shown.out)["open-loop"][:2] == ["2", "2"]
    assert "2 of 4 worlds" in shown.err
