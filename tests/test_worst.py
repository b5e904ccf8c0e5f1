"""studies/worst.py: what is left out of a phantom changes nothing else, and no study is taken for another."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

import flexneedle
from flexneedle.errors import InputError

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))
import worst

OUT_OF = {
    "moduli": {"superficial", "deep"},
    "variation": {"ahead"},
    "boundary": {"boundary"},
    "bevel": {"bevel"},
    "start": {"offset", "slope"},
}
NOMINAL = {
    "superficial": 1.0,
    "deep": 1.0,
    "ahead": 1.0,
    "boundary": 20.0,
    "bevel": 1.0,
    "offset": 0.0,
    "slope": 0.0,
}


@pytest.mark.parametrize("variant", worst.WITHOUT)
@pytest.mark.parametrize("seed", [3, 208988])
def test_leaving_one_thing_out_leaves_all_else_as_it_was_drawn(variant, seed):
    scenario = flexneedle.load_scenario("phantom")  # the target is 40 mm deep, the boundary 20 mm
    before = asdict(worst.drawn(scenario, seed))
    after = asdict(worst.drawn(scenario.with_values(worst.WITHOUT[variant]), seed))
    gone = OUT_OF.get(variant, set())
    assert all(before[name] != NOMINAL[name] for name in before)
    assert {name: after[name] for name in gone} == pytest.approx({name: NOMINAL[name] for name in gone})
    assert {name: after[name] for name in after if name not in gone} == pytest.approx(
        {name: before[name] for name in before if name not in gone}
    )


def test_a_folder_is_not_taken_for_another_study(tmp_path):
    stored = json.loads(json.dumps(worst.load_study("mismatch-doubled").definition))
    (tmp_path / "study.json").write_text(json.dumps({"study": stored}))
    assert worst.of_folder(tmp_path, None).first_seed == 200000
    (tmp_path / "study.json").write_text(json.dumps({"study": {**stored, "first_seed": 5}}))
    with pytest.raises(InputError, match="not the study mismatch-doubled: name its file with --study"):
        worst.of_folder(tmp_path, None)
