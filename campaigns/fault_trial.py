"""One trial: a separate emulated rig, an insertion on it, a fault at a random time, and the record."""

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from signal import SIGCONT, SIGKILL, SIGSTOP
from time import monotonic, sleep
from typing import Any
from zlib import crc32

import numpy as np
import psutil

import flexneedle
from fault_cases import Case
from fault_injections import Running, Signal
from fault_judging import Evidence, good
from fault_list import Fault
from flexneedle.scenario.files import dump_scenario
from flexneedle.types import Floats
from rig_trials import EmulatedRig, emulated_rig, insertion, wait_for_end

_LEFT = 6  # steps: some faults show only after a few
_FIRST_STEP = 3  # in which a decision is late or rolls
_PHASE_S = 0.3  # of a step and the rest after it
_EARLIEST_S = 0.2  # after the first advance
_ROLL_SHARES = (0.1, 0.8)  # of the time of the roll at its speed, since the decision
_ATTEMPTS = 5
_STOPPED_S = 3.0  # for which a controller is stopped by SIGSTOP
_LONGEST_S, _END_S, _REST_S = 60.0, 5.0, 0.6
_CONTROLLER = '''"""The default controller, one of whose decisions takes long or rolls the needle."""

import time
from dataclasses import replace

from flexneedle.control.controllers import DEFAULT, CONTROLLERS

_count = iter(range(10**6))


def _decide(task, memory, estimate, rng):
    late = next(_count) == {step}
    if late and {seconds}:
        print(time.monotonic(), file=open("marker", "w"))
        time.sleep({seconds})
    decision, memory = CONTROLLERS[DEFAULT].decide(task, memory, estimate, rng)
    if late and {roll}:
        print(time.monotonic(), file=open("marker", "w"))
        decision = replace(decision, command=decision.command._replace(roll={roll}))
    return decision, memory


OWN = replace(CONTROLLERS[DEFAULT], name="own", decide=_decide)
'''
_UNFINISHED = '"status": "running"'
_HEAD = 200  # characters of run.json, among which the status is


@dataclass(frozen=True)
class Trial:
    """A fault in a case, with its randomness: when it is injected."""

    fault: Fault
    case: Case

    @property
    def rolls(self) -> bool:
        """Return whether the fault falls in a roll."""
        return self.fault.falls_in_roll(self.case.rolls)

    @property
    def axis(self) -> str:
        """The axis that is faulty, if one is."""
        return "rotation" if self.rolls else self.fault.axis

    @property
    def key(self) -> dict[str, Any]:
        """Values that identify its row: trials of the same fault in the same insertion have equal ones."""
        scenario = self.case.scenario
        return {
            "group": self.fault.group,
            "fault": self.fault.name,
            "timing": self.case.number,
            "scenario": scenario.name,
            "target_mm": list(scenario.target.position),
            "seed": self.case.seed,
            "axis": self.axis,
            "rolls": self.rolls,
        }

    def rng(self, attempt: int = 0) -> np.random.Generator:
        """Randomness of its time, in the nth attempt to run it."""
        name = crc32(f"{self.fault.group} {self.fault.name}".encode())
        return np.random.default_rng([self.case.seed, name, attempt][: 3 if attempt else 2])


def run_trial(trial: Trial, keep: Path | None = None) -> dict[str, Any]:
    """Run one trial; return its row. keep: folder for the record of the insertion.

    A fault that came too late for its roll, as the computer was busy, is tried again.
    Raises RuntimeError if the insertion ends before the fault is injected, or a process of the rig does.
    """
    for attempt in range(_ATTEMPTS):
        row = _attempt(trial, trial.rng(attempt), keep)
        if not trial.rolls or row["during"] == "roll" or not good(trial.fault, row):
            break
    return row | {"attempts": attempt + 1}


def _attempt(trial: Trial, rng: np.random.Generator, keep: Path | None) -> dict[str, Any]:
    fault, case = trial.fault, trial.case
    begun = monotonic()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="faults-")))
        setting = fault.injection.prepare(folder, stack)
        (folder / "scenario.toml").write_text(
            dump_scenario(case.with_fibre if fault.fibre else case.scenario)
        )
        roll = case.roll(rng) if trial.rolls else 0.0
        options = _controller(trial, roll, folder, rng)
        scenario = str(folder / "scenario.toml")
        rig = stack.enter_context(emulated_rig(folder, scenario, case.seed))
        options = ("--seed", str(case.seed), *options)
        process = insertion(
            rig.rig, scenario, setting.record, *options, environment=setting.environment, cwd=folder
        )
        stack.callback(_kill, process)
        due = _await_moment(trial, roll, process, rig, folder, rng)
        controller = psutil.Process(process.pid)
        others = tuple(controller.children(recursive=True))
        ordered = due if fault.decision_s else monotonic()
        effective = fault.injection.inject(Running(rig, folder, trial.axis, controller, others))
        injected = due if fault.decision_s else effective
        _await_end(fault, process, injected, setting.record / "run.json")
        status, printed, errors = wait_for_end(process, _END_S)
        sleep(_REST_S)
        if keep is not None and setting.record.exists():
            name = f"{fault.group}-{fault.name}-{case.number}".replace(" ", "-")
            shutil.copytree(setting.record, keep / name, dirs_exist_ok=True)
        run = _read_record(setting.record, printed)
        times, left = (ordered, injected), _ended_by_force(others)
        truth, commands = rig.read_truth(), _commands(setting.record, trial.axis)
        step = case.scenario.setup.max_advance_mm
        evidence = Evidence(fault, trial.axis, *times, truth, run, errors, left, commands, step)
        row = trial.key | {"roll_deg": round(degrees(roll), 1)} | evidence.row()
    return row | {"exit_status": status, "seconds": monotonic() - begun}


def _controller(trial: Trial, roll: float, folder: Path, rng: np.random.Generator) -> tuple[str, ...]:
    """Return the options for a custom controller, one decision of which is late or rolls the needle."""
    if not (roll or trial.fault.decision_s):
        return ()
    step = int(rng.integers(_FIRST_STEP, int(trial.case.steps) - _LEFT))
    values = {"step": step, "seconds": trial.fault.decision_s, "roll": roll}
    (folder / "own.py").write_text(_CONTROLLER.format(**values))
    return ("--controller", "own:OWN")


def _await_moment(
    trial: Trial,
    roll: float,
    process: subprocess.Popen[bytes],
    rig: EmulatedRig,
    folder: Path,
    rng: np.random.Generator,
) -> float:
    """Wait until the fault is due; return that time (s, monotonic), for a late decision its beginning."""
    begun = _first_advance(rig, process)
    if trial.fault.decision_s:
        return _read_marker(folder / "marker", process)
    if roll:
        shares = rng.uniform(*_ROLL_SHARES)
        due = _read_marker(folder / "marker", process) + shares * trial.case.roll_s(roll)
    else:
        step = float(rng.uniform(0.0, trial.case.steps - _LEFT))
        _await_depth(step * trial.case.scenario.setup.max_advance_mm, rig, process)
        due = max(monotonic(), begun + _EARLIEST_S) + float(rng.uniform(0.0, _PHASE_S))
    while monotonic() < due:
        _check_running(process)
        sleep(min(0.05, max(0.0, due - monotonic())))
    return due


def _first_advance(rig: EmulatedRig, process: subprocess.Popen[bytes]) -> float:
    """Wait until the base moves; before that the needle may be rolled, and the field measured."""
    rig.first_motion(process)
    while True:
        truth = rig.read_truth()
        moving = truth.time[truth.positions["insertion"] != truth.positions["insertion"][0]]
        if len(moving):
            return float(moving[0])
        _check_running(process)
        sleep(0.1)


def _await_depth(travel: float, rig: EmulatedRig, process: subprocess.Popen[bytes]) -> None:
    """Wait until the base has moved by this distance (mm)."""
    while True:
        base = rig.read_truth().positions["insertion"]
        if base[-1] - base[0] >= travel:
            return
        _check_running(process)
        sleep(0.05)


def _read_marker(marker: Path, process: subprocess.Popen[bytes]) -> float:
    """Wait for the time that the controller writes."""
    while not (marker.exists() and marker.read_text().endswith("\n")):
        _check_running(process)
        sleep(0.005)
    return float(marker.read_text())


def _check_running(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        raise RuntimeError(f"the insertion ended before its fault: {wait_for_end(process)}")


def _await_end(fault: Fault, process: subprocess.Popen[bytes], injected: float, record: Path) -> None:
    """Wait until the insertion ends. If a signal has stopped it, continue it once that must have been detected.

    An insertion with a complete record is ended: its pictures would take more processor time than the insertion.
    """
    if fault.injection == Signal(SIGSTOP):
        sleep(max(0.0, injected + _STOPPED_S - monotonic()))
        os.kill(process.pid, SIGCONT)
    deadline = monotonic() + _LONGEST_S
    while process.poll() is None and monotonic() < deadline:
        sleep(0.05)
        if record.exists() and _UNFINISHED not in record.read_text()[:_HEAD]:
            process.kill()
            return


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, SIGKILL)
        process.wait()


def _ended_by_force(processes: tuple[psutil.Process, ...]) -> int:
    """Kill the processes that have not ended with the insertion; return their number."""
    left = [one for one in processes if one.is_running() and one.status() != psutil.STATUS_ZOMBIE]
    for one in left:
        one.kill()
    return len(left)


def _commands(record: Path, axis: str) -> Floats | None:
    """The commands (m, 9) of the insertion, where a fault is of an axis that moves seldom."""
    if axis in ("insertion", "rotation"):
        return None
    return np.array([period.command for period in flexneedle.load(record).periods])


def _read_record(record: Path, printed: str) -> Mapping[str, Any]:
    """Return the record of the insertion in its folder, or its printed error if that could not be written."""
    file = record / "run.json"
    run: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    if run.get("status") == "running" and printed.startswith("{"):
        result = json.loads(printed)
        run |= {"status": result["outcome"], "reason": result["reason"], "timing": result["timing"]}
    return run
