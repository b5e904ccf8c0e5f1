"""studies/rig_faults.py: what a trial counts as, and its table, of earlier trials, too. No insertion is run."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

STUDIES = Path(__file__).parents[1] / "studies"
OLD = {
    "group": "motors", "fault": "guide stalls", "timing": 0, "status": 1, "outcome": "failed", "reason": "", "why": "",
    "state": "fault", "detection_s": 3.5, "motion_mm": 0.0, "rests": True, "errors": "",
}  # fmt: skip
NEW = OLD | {"timing": 1, "from_motion_s": 0.75}
QUIET = OLD | {
    "group": "computer", "fault": "clock set back by 1 h", "outcome": "done", "state": None, "detection_s": None,
    "motion_mm": None,
}  # fmt: skip


def row(folder, *trials):
    """The last cells of the row of these trials (detection, motion, as required), and the exit status of the study."""
    (folder / "trials.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in trials))
    name = trials[0]["fault"]
    command = [sys.executable, STUDIES / "rig_faults.py", "--timings", "0", "--only", name, "--out", folder]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stderr == ""
    (line,) = [line for line in done.stdout.splitlines() if f"| {name} |" in line]
    return [cell.strip() for cell in line.split("|")[-4:-1]], done.returncode


@pytest.mark.parametrize(
    ("trials", "shown", "status"),
    [
        ([OLD], ["– (0.9)", "0.000", "1 of 1"], 0),  # it has not recorded the time
        ([OLD, NEW], ["0.750 (0.9)", "0.000", "2 of 2"], 0),
        ([NEW, NEW | {"from_motion_s": 0.95}], ["0.950 (0.9)", "0.000", "1 of 2"], 1),
        ([NEW, NEW | {"from_motion_s": None, "state": None}], ["0.750 (0.9)", "0.000", "1 of 2"], 1),
    ],
)
def test_a_stall_of_the_guide_has_the_time_since_its_motion_began(tmp_path, trials, shown, status):
    assert row(tmp_path, *trials) == (shown, status)


def test_a_guide_that_does_not_move_again_need_not_be_detected(tmp_path):
    resting = NEW | {"outcome": "done", "state": None, "from_motion_s": None}
    assert row(tmp_path, resting) == (["– (0.9)", "0.000", "1 of 1"], 0)


def test_an_insertion_that_must_continue_is_neither_held_nor_stopped(tmp_path):
    held = QUIET | {"state": "holding", "why": "missing: tip not measured (missing)", "detection_s": 0.1}
    assert row(tmp_path, QUIET) == (["–", "–", "1 of 1"], 0)
    assert row(tmp_path, QUIET, held) == (["–", "–", "1 of 2"], 1)


def test_a_gap_as_long_as_the_monitors_limit_may_be_a_hold(tmp_path):
    gap = QUIET | {"group": "tracker", "fault": "missing for 0.1 s"}
    held = gap | {"state": "holding", "why": "missing: tip not measured (missing)", "detection_s": 0.1}
    assert row(tmp_path, gap, held) == (["–", "–", "2 of 2"], 0)


def judged(name, states, time, base):
    """The result of a trial of a fault at 10 s, by its states and the base over time (s, mm)."""
    script = (
        "import json, sys; import numpy as np; import rig_faults as study\n"
        "from flexneedle.rig.emulator.coupled.truth import Truth\n"
        "name, states, time, base = json.load(sys.stdin)\n"
        "none = np.zeros(len(time))\n"
        "truth = Truth(np.array(time), {}, {'insertion': np.array(base)}, *[none] * 5)\n"
        "(fault,) = [one for one in study._faults() if one.name == name]\n"
        "run = {'status': 'done', 'timing': {'ticks': {'states': states}}}\n"
        "print(json.dumps(study._judged(fault, 0, truth, 10.0, run, 0, '')))\n"
    )
    given = json.dumps((name, states, list(time), list(base)))
    done = subprocess.run(
        [sys.executable, "-c", script], input=given, cwd=STUDIES, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def state(time, name, why=""):
    return {"time_s": time, "state": name, "why": why}


END = state(20.0, "stopped", "the controller")


def test_the_time_counts_from_the_last_motion_of_the_base():
    """Steps of 0.2 s and 1 mm, each 0.3 s after the last, and none after the one at 12 s."""
    time = np.arange(9.0, 21.0, 0.004)
    steps = np.clip((time[:, None] - np.arange(9.0, 12.01, 0.3)) / 0.2, 0.0, 1.0).sum(axis=1)
    found = judged("guide stalls", [state(12.75, "fault", "the motors have not arrived"), END], time, steps)
    assert found["state"] == "fault"
    assert found["detection_s"] == pytest.approx(2.75)
    assert found["from_motion_s"] == pytest.approx(0.75, abs=0.005)


def test_the_end_of_an_insertion_is_no_detection_and_a_hold_is_one():
    still = ([9.0, 21.0], [0.0, 0.0])
    assert judged("missing for 0.1 s", [state(9.0, "inserting"), END], *still)["state"] is None
    hold = state(10.1, "holding", "missing: tip not measured (missing)")
    found = judged("missing for 0.1 s", [hold, state(10.2, "inserting"), END], *still)
    assert (found["state"], found["from_motion_s"]) == ("holding", None)
