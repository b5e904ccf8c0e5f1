"""studies/worst.py: removing one imperfection changes nothing else, and a folder of another study is refused."""

import json
from dataclasses import asdict
from types import SimpleNamespace

import pytest

import flexneedle
import worst
from flexneedle.errors import InputError

REMOVED = {
    "moduli": {"superficial", "deep"},
    "variation": {"last_ratio"},
    "boundary": {"boundary"},
    "bevel": {"bevel"},
    "start": {"offset", "slope"},
}
NOMINAL = {
    "superficial": 1.0,
    "deep": 1.0,
    "last_ratio": 1.0,
    "boundary": 20.0,
    "bevel": 1.0,
    "offset": 0.0,
    "slope": 0.0,
}


@pytest.mark.parametrize("variant", worst.WITHOUT)
@pytest.mark.parametrize("seed", [3, 208988])
def test_removing_one_imperfection_leaves_the_other_draws_unchanged(variant, seed):
    scenario = flexneedle.load_scenario("phantom")  # the target is 40 mm deep, the boundary 20 mm
    before = asdict(worst.parameters_of(scenario, seed))
    after = asdict(worst.parameters_of(scenario.with_values(worst.WITHOUT[variant]), seed))
    removed = REMOVED.get(variant, set())
    assert all(before[name] != NOMINAL[name] for name in before)
    assert {name: after[name] for name in removed} == pytest.approx({name: NOMINAL[name] for name in removed})
    assert {name: after[name] for name in after if name not in removed} == pytest.approx(
        {name: before[name] for name in before if name not in removed}
    )


def test_a_folder_of_another_study_is_refused(tmp_path):
    stored = json.loads(json.dumps(worst.load_study("mismatch-doubled").definition))
    (tmp_path / "study.json").write_text(json.dumps({"study": stored}))
    assert worst.of_folder(tmp_path, None).first_seed == 200000
    (tmp_path / "study.json").write_text(json.dumps({"study": {**stored, "first_seed": 5}}))
    with pytest.raises(InputError, match="not the study mismatch-doubled: give its file with --study"):
        worst.of_folder(tmp_path, None)


def ending(error, held=False):
    return worst.Ending(error, 0.0, error, 0.0, 0.0, 1.0, held)


def test_held_insertions_are_counted_and_not_averaged(capsys, monkeypatch):
    """Errors 0.1 and 0.3 mm average to 0.2 mm; the miss of the held insertion, 18 mm, has no part in it."""
    monkeypatch.setattr(worst, "WITHOUT", dict.fromkeys(("nothing", "bevel", "start")))
    insertions = [SimpleNamespace(index=7)]
    held = [ending(18.0, held=True)] * 2
    worst.print_variants(insertions, [[[ending(0.1), ending(0.3)], [ending(0.1), *held, ending(0.3)], held]])
    head, _, row, mean, _ = capsys.readouterr().out.splitlines()
    assert head == "| index | nothing | bevel | start |"
    assert row == "| 7 | 0.20 (0.30) | 0.20 (0.30), 2 held | –, 2 held |"
    assert mean == "| mean | 0.20 | 0.20, 2 held | –, 2 held |"


def test_the_tracker_of_every_variant_has_jitter():
    """Without jitter, identical readings count as a frozen sensor and the needle is held."""
    scenario = flexneedle.load_scenario("phantom")
    jitter = [scenario.with_values(changes).tracker.jitter_mm for changes in worst.WITHOUT.values()]
    assert min(jitter) > 0.0
    assert jitter[list(worst.WITHOUT).index("jitter, delay")] < 0.1 * scenario.tracker.jitter_mm
