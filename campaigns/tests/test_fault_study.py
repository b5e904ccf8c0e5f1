"""campaigns/rig_faults.py: judgement of a trial by the states of its supervisor; cases, table, picture.

No insertion is run.
"""

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flexneedle.lab.emulators.emulated_rig.truth import TruthRecord
from flexneedle.lab.rig.preflight.fit import fit_problems
from flexneedle.lab.rig.rig_file import load_rig

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "campaigns"))
import rig_faults as study
from fault_cases import FIRST_WORLD, MOST_PATH_MM, case
from fault_injections import Clock
from fault_judging import Evidence, good, problems
from fault_list import FAULTS
from fault_report import draw, table
from fault_trial import Trial, run_trial

BY_NAME = {fault.name: fault for fault in FAULTS}
INJECTED = 10.0
END = (20.0, "stopped", "the controller")
MISSING = "missing: tip not measured (missing)"


REASONS = {
    "disk full": "trace.mcap cannot be written: No space left on device",
    "supervisor killed": "the supervisor has ended: it was killed",
}


def evidence(name, *states, outcome="done", reason=None, moves=(), left=0, axis="insertion", commands=None):
    """Of a fault at 10 s: states that the supervisor has entered, motions of the base (begin and end in s, mm)."""
    time = np.arange(8.0, 23.0, 0.004)
    base = sum((np.clip((time - a) / (b - a), 0.0, 1.0) * mm for a, b, mm in moves), np.zeros(len(time)))
    positions = {"insertion": base, "rotation": np.zeros(len(time))}
    recorded = [{"time_s": at, "state": state, "why": why} for at, state, why in states]
    reason = REASONS.get(name, "") if reason is None else reason
    run = {"status": outcome, "reason": reason, "timing": {"ticks": {"states": recorded}}}
    truth = TruthRecord(time, {}, positions, *[np.zeros(len(time))] * 5)
    return Evidence(BY_NAME[name], axis, INJECTED - 0.02, INJECTED, truth, run, "", left, commands)


def row(name, *states, **more):
    found = evidence(name, (9.0, "inserting", ""), *states, **more)
    return found.row() | {"group": found.fault.group, "fault": name, "axis": found.axis, "timing": 0}


def wrong(name, *states, **more):
    return problems(BY_NAME[name], row(name, *states, **more))


OFF = (10.02, "fault", "insertion: the motor is off")
HOLD, GO_ON = (10.1, "holding", MISSING), (10.7, "inserting", "")
INTERRUPT = (10.02, "stopped", "signal SIGINT")


@pytest.mark.parametrize(
    ("name", "states", "outcome"),
    [
        ("motor off", [OFF], "failed"),
        ("missing for 2 s", [HOLD, END], "held"),
        ("missing for 0.5 s", [HOLD, GO_ON, END], "done"),
        ("clock set forward by 1 h", [END], "done"),
        ("Ctrl-C", [INTERRUPT], "interrupted"),
        ("disk full", [(10.4, "stopped", "the controller")], "held"),
        ("frozen: values repeat", [(10.4, "holding", "frozen: 9 identical readings"), END], "held"),
        ("frozen: values repeat", [(10.4, "holding", "innovation: 1 mm, limit 1 mm"), END], "held"),
        ("garbled", [(10.4, "holding", "missing: no reading for 0.2 s (no reply)"), END], "held"),
        ("? in reply", [(10.02, "fault", "TPABCD refused: 7 Command not valid while running")], "failed"),
        ("no replies", [(10.1, "fault", "no reply in time (to TPABCD)")], "failed"),
        ("controller killed", [], "running"),
        ("supervisor killed", [], "failed"),
    ],
)
def test_the_required_reaction_is_good(name, states, outcome):
    assert wrong(name, *states, outcome=outcome) == []


@pytest.mark.parametrize(
    ("name", "states", "outcome", "problem"),
    [
        ("motor off", [], "failed", "states: none"),
        ("motor off", [(9.9, *OFF[1:])], "failed", "states: none"),
        ("motor off", [(10.02, "stopped", "insertion: the motor is off")], "failed", "states: stopped"),
        ("motor off", [OFF], "interrupted", "outcome: interrupted"),
        ("motor off", [(10.02, "fault", "guide_y: the motor is off")], "failed", "reason: guide_y"),
        ("motor off", [OFF, (11.0, "idle", ""), (11.1, "armed", "")], "failed", "states: fault idle armed"),
        ("missing for 2 s", [(10.1, "fault", MISSING)], "held", "states: fault"),
        ("missing for 2 s", [END], "held", "states: end"),
        ("missing for 2 s", [HOLD, GO_ON, END], "held", "states: holding inserting end"),
        ("missing for 2 s", [(10.1, "holding", "jumped by 5 mm"), END], "held", "reason: jumped"),
        ("missing for 0.5 s", [HOLD, END], "done", "states: holding end"),
        ("clock set forward by 1 h", [HOLD, GO_ON, END], "done", "states: holding inserting end"),
        ("Ctrl-C", [(10.02, "stopped", "no heartbeat")], "interrupted", "reason: no heartbeat"),
        ("guide stalls", [(11.0, "fault", "guide_y: stalls")], "done", "outcome: done"),
        ("supervisor killed", [OFF], "failed", "states: fault"),
        ("motor off", [(10.25, *OFF[1:])], "failed", "detection: 0.25"),
        ("frozen: values repeat", [HOLD, END], "held", "reason: missing"),
        ("jump of 5 mm", [HOLD, END], "held", "reason: missing"),
        ("? in reply", [OFF], "failed", "reason: insertion"),
    ],
)
def test_another_state_reason_or_outcome_is_not(name, states, outcome, problem):
    found = wrong(name, *states, outcome=outcome)
    assert any(one.startswith(problem) for one in found), found


def test_every_detected_fault_has_a_reason_and_states_that_a_supervisor_can_record():
    unrecorded = {"controller killed", "both killed"}
    for fault in FAULTS:
        quiet = fault.within is None or fault.name in unrecorded or fault.decision_s == 0.5
        assert quiet or fault.because, fault.name
        for pattern in fault.reaction.outcomes:
            assert set(re.findall("[a-z]+", pattern)) <= {"holding", "inserting", "stopped", "fault", "end"}
    assert len({(fault.group, fault.name) for fault in FAULTS}) == len(FAULTS)


def test_the_status_of_the_insertion_is_the_reason_if_the_supervisor_has_none():
    full, held = (10.4, "stopped", "the controller"), "held for 1.1 s (limit 1 s): missing"
    assert wrong("disk full", full, outcome="held", reason=held) == [f"reason: {held}"]
    assert wrong("supervisor killed", outcome="failed", reason="late") == ["reason: late"]


def test_a_killed_process_is_timed_until_all_axes_rest():
    found = row("both killed", outcome="running", moves=[(9.9, 10.1, 0.5)])
    assert found["rest_s"] == pytest.approx(0.1, abs=0.005)
    assert good(BY_NAME["both killed"], found)
    late = wrong("both killed", outcome="running", moves=[(9.9, 10.5, 0.4)])
    assert [one[:8] for one in late] == ["rest: 0."]
    assert row("motor off", OFF)["rest_s"] is None


def test_a_reaction_may_come_before_the_fault_is_reported_and_not_before_it_is_ordered():
    early = (9.99, *OFF[1:])
    assert row("motor off", early, outcome="failed")["detection_s"] == 0.0
    assert wrong("motor off", early, outcome="failed") == []


def test_a_roll_that_stalls_is_a_fault_of_the_rotation():
    stalled = (10.1, "fault", "rotation: the motor does not follow")
    assert wrong("roll stalls", stalled, outcome="failed", axis="rotation") == []
    assert wrong("roll stalls", OFF, outcome="failed", axis="rotation") == [f"reason: {OFF[2]}"]


@pytest.mark.parametrize(
    ("name", "states", "outcome", "moves", "problem"),
    [
        ("motor off", [OFF], "failed", (10.0, 10.4, 0.45), ""),
        ("motor off", [OFF], "failed", (10.1, 10.4, 0.6), "motion: 0."),
        ("motor off", [OFF], "failed", (10.1, 25.0, 0.45), "no rest"),
        ("missing for 0.5 s", [HOLD, GO_ON, END], "done", (10.8, 11.8, 5.0), ""),  # the hold has ended
        ("missing for 0.5 s", [HOLD, GO_ON, END], "done", (10.2, 10.6, 2.0), "motion: 2."),
        ("decision of 0.5 s", [END], "done", (10.6, 11.0, 1.0), ""),
        ("decision of 0.5 s", [END], "done", (10.1, 10.4, 1.0), "motion: 1."),
    ],
)
def test_motion_after_detection_is_a_problem(name, states, outcome, moves, problem):
    found = wrong(name, *states, outcome=outcome, moves=[moves])
    assert any(one.startswith(problem) for one in found) if problem else found == []


def test_the_time_of_a_guide_that_stalls_counts_from_the_last_motion_of_the_base():
    steps = [(9.0 + 0.3 * k, 9.2 + 0.3 * k, 1.0) for k in range(11)]  # the last one at 12 s
    found = row(
        "guide stalls",
        (12.75, "fault", "guide_y has not arrived"),
        outcome="failed",
        moves=steps,
        axis="guide_y",
    )
    assert found["detection_s"] == pytest.approx(2.75)
    assert found["from_motion_s"] == pytest.approx(0.75, abs=0.005)
    assert good(BY_NAME["guide stalls"], found)
    assert not good(BY_NAME["guide stalls"], found | {"from_motion_s": 0.95})


def stalled_base(detected, guide, moves=()):
    """The row of a base that stalls, while guide_y moves at times (begin in s, mm) for 0.2 s."""
    states = (9.0, "inserting", ""), (detected, "fault", "insertion: off")
    found = evidence("stall", *states, outcome="failed", moves=moves)
    time = found.truth.time
    found.truth.positions["guide_y"] = sum(mm * np.clip((time - at) / 0.2, 0.0, 1.0) for at, mm in guide)
    return found.row() | {"axis": "insertion"}


@pytest.mark.parametrize(("fault_to_step", "seconds"), [(0.7, 0.1), (0.0, 0.1), (-0.1, 0.0)])
def test_the_time_of_a_base_that_stalls_counts_from_its_next_step_which_the_guide_shows(
    fault_to_step, seconds
):
    step = INJECTED + fault_to_step
    shown = stalled_base(step + 0.1, [(step, 0.01), (step - 1.2, 0.01)])
    assert shown["detection_s"] == pytest.approx(max(0.0, fault_to_step + 0.1))
    assert shown["from_motion_s"] == pytest.approx(seconds, abs=0.005)
    assert good(BY_NAME["stall"], shown)
    assert not good(BY_NAME["stall"], shown | {"from_motion_s": 0.41})
    assert not good(BY_NAME["stall"], shown | {"from_motion_s": None, "detection_s": None})


@pytest.mark.parametrize(
    ("moves", "seconds"),
    [
        ([], 0.6),  # at rest, and missed in a step
        ([(9.9, 10.0, 0.97)], 0.6),  # next to the end of a step
        ([(9.9, 10.0, 0.6)], 1.0),  # in a step, and missed there
    ],
)
def test_a_base_that_stalls_may_be_missed_in_no_step(moves, seconds):
    shown = stalled_base(11.0, [(9.9, 1.0), (10.4, 1.0), (10.8, 1.0)], moves)
    assert shown["from_motion_s"] == pytest.approx(seconds, abs=0.005)
    assert not good(BY_NAME["stall"], shown)


def test_a_guide_that_stalls_may_be_missed_only_if_it_was_to_move_no_farther():
    """Six steps of 1 mm are made or begin at the fault; in each later one the guide is to move by 0.002 mm."""
    steps = [(8.5 + 0.3 * k, 8.7 + 0.3 * k, 1.0) for k in range(12)]
    commands = np.zeros((12, 9))
    commands[:, 0], commands[:6, 5], commands[6:, 5] = 1.0, 0.5, 0.002
    given = {"moves": steps, "axis": "guide_y"}
    found = row("guide stalls", END, commands=commands, **given)
    assert found["commanded_mm"] == pytest.approx(0.012)
    assert good(BY_NAME["guide stalls"], found)
    commands[8, 5] = 0.1
    found = row("guide stalls", END, commands=commands, **given)
    assert found["commanded_mm"] == pytest.approx(0.11)
    assert problems(BY_NAME["guide stalls"], found) == ["detection: None"]


def test_cases_are_a_family_that_fits_the_rig():
    cases, rig = [case(number) for number in range(20)], load_rig("emulated")
    setups = [one.scenario.setup for one in cases]
    assert [fit_problems(rig, one.scenario) for one in cases] == [[]] * 20
    assert all(one.path_mm <= MOST_PATH_MM and one.scenario.setup.has_guide for one in cases)
    assert sum(setup.axes == 2 for setup in setups) == 10
    kinds = {(setup.guide_axes, setup.half_turns) for setup in setups if setup.axes == 2}
    assert kinds == {(1, True), (1, False), (2, True), (2, False)}
    worlds = [int(name.split()[1]) for one in cases if (name := one.scenario.name).startswith("World")]
    assert len(set(worlds)) == 10
    assert min(worlds) >= FIRST_WORLD
    in_rolls = [one for one in cases if one.rolls]
    assert len(in_rolls) == 6
    assert {one.scenario.setup.axes for one in in_rolls} == {1, 2}
    assert {one.scenario.setup.half_turns for one in in_rolls} == {True, False}


@pytest.mark.parametrize(
    ("fault", "number", "axis"),
    [
        ("motor off", 2, "rotation"),
        ("motor off", 3, "insertion"),
        ("stall", 2, "insertion"),  # never in a roll
        ("roll stalls", 3, "rotation"),
        ("guide stalls", 2, "guide_y"),
    ],
)
def test_in_rolls_the_rotation_is_faulty(fault, number, axis):
    assert Trial(BY_NAME[fault], case(number)).axis == axis


def test_a_fault_that_came_too_late_for_its_roll_is_tried_again(monkeypatch):
    tried = []

    def attempted(trial, rng, keep):
        tried.append((trial, rng.random(), keep))
        return {"during": "rest" if len(tried) < 3 else "roll"}

    monkeypatch.setattr("fault_trial._attempt", attempted)
    monkeypatch.setattr("fault_trial.good", lambda _, row: row["during"] != "bad")
    in_roll, elsewhere = Trial(BY_NAME["roll stalls"], case(3)), Trial(BY_NAME["motor off"], case(3))
    assert run_trial(in_roll) == {"during": "roll", "attempts": 3}
    assert len({time for _, time, _ in tried}) == 3
    assert tried[0][1] == in_roll.rng().random()
    tried.clear()
    assert run_trial(elsewhere) == {"during": "rest", "attempts": 1}
    monkeypatch.setattr("fault_trial._attempt", lambda *_: {"during": "bad"})
    assert run_trial(in_roll) == {"during": "bad", "attempts": 1}  # whatever it was, it is not good


def test_table_and_picture(tmp_path):
    bad = row("motor off", END, outcome="failed")
    rows = [row("motor off", OFF, outcome="failed"), bad, row("controller killed", outcome="running")]
    lines = table(FAULTS, rows).splitlines()
    assert lines[2] == "|motors|motor off|fault (1 of 2)|failed|0.020 (0.1)|0.000|0.0|"
    assert lines[3] == "|computer|controller killed|stop|no record|at rest: 0.000 (0.225)|0.000|0.0|"
    assert lines[-1] == "3 faults, during: 0 an advance, 0 a roll, 3 a rest between two steps."
    draw(FAULTS, rows, tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 10_000


def test_existing_rows_are_not_run_again_unless_they_are_of_another_insertion(tmp_path, capsys, monkeypatch):
    def run_trial(trial, **_):
        return row(trial.fault.name, OFF, outcome="failed") | trial.key | {"seconds": 1.0}

    monkeypatch.setattr(study, "run_trial", run_trial)
    monkeypatch.setattr(study, "draw", lambda *_: None)
    options = ["--only", "motor off", "--timings", "2", "--out", str(tmp_path)]
    assert study.main(options) == 0
    assert capsys.readouterr().err.count("ok motors") == 2
    file = tmp_path / "rows.jsonl"
    kept = [json.loads(line) for line in file.read_text().splitlines()]
    file.write_text("".join(f"{json.dumps(one)}\n" for one in (kept[0], kept[1] | {"seed": 0})))
    assert study.main(options) == 0
    assert capsys.readouterr().err.count("ok motors") == 1


INTERRUPTED = """
import os, signal, subprocess, sys
from pathlib import Path
sys.path.insert(0, {studies!r})
from rig_trials import resume_rows

def run(task):
    for _ in range(2):  # what a task starts after the interrupt ends, too
        process = subprocess.Popen(["sleep", "600"])
        if task == 1:
            process.send_signal(signal.SIGSTOP)
        os.write(1, f"{{process.pid}}\\n".encode())  # at once: two tasks write
        process.wait()
    raise RuntimeError("ended")

list(resume_rows(Path({file!r}), [1, 2, 3], run, 2, lambda task: {{"task": task}}))
"""


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM])
def test_no_process_is_left_after_an_interrupt(tmp_path, number):
    text = INTERRUPTED.format(studies=str(Path(study.__file__).parent), file=str(tmp_path / "rows.jsonl"))
    study_of = subprocess.Popen(
        [sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        pids = [int(study_of.stdout.readline()) for _ in range(2)]
        study_of.send_signal(number)
        pids.append(int(study_of.stdout.readline()))
        study_of.send_signal(number)  # another one is ignored
        pids += map(int, study_of.stdout.read().split())
    finally:
        study_of.kill()
        study_of.communicate()
    assert len(pids) == 4
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert not (tmp_path / "rows.jsonl").exists()


def test_a_stepped_clock_belongs_to_the_processes_that_have_it(tmp_path):
    with ExitStack() as stack:
        clock = Clock(3600)
        setting = clock.prepare(tmp_path, stack)
        printed = [sys.executable, "-c", "import time; print(flush=True); input(); print(time.time())"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        process, usual = (
            stack.enter_context(subprocess.Popen(printed, env=os.environ | more, **pipes))
            for more in (setting.environment, {})
        )
        for each in (process, usual):
            each.stdout.readline()  # it runs, with its libraries
        stepped = SimpleNamespace(folder=tmp_path, controller=process, supervisor=process)
        half = SimpleNamespace(folder=tmp_path, controller=process, supervisor=usual)
        with pytest.raises(RuntimeError, match=f"process {usual.pid} has the usual clock"):
            clock.inject(half)
        clock.inject(stepped)
        (shifted, _), (now, _) = process.communicate("\n"), usual.communicate("\n")
        assert float(shifted) - float(now) == pytest.approx(3600.0, abs=60.0)
