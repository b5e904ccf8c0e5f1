"""A `flexneedle insert` that is killed leaves all periods up to the last complete one."""

import json
import os
import signal
import time
from multiprocessing import get_context

import numpy as np
import pytest

import flexneedle
from counted_command import counted
from flexneedle.cli import main as cli
from flexneedle.record.fields import to_row
from flexneedle.record.reader import read_trace
from flexneedle.results import Outcome
from flexneedle.scenario.files import dump_scenario

TIMINGS = 4
LONGEST_S = 60.0
QUICK = {
    "target.depth_mm": 3.0, "target.lateral_mm": 0.0, "plan.samples": 16, "plan.iterations": 2,
    "plan.max_iterations": 2, "needle.nodes": 15, "phantom.element_mm": 5.0, "phantom.contact_spacing_mm": 2.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("killed") / "quick.toml"
    path.write_text(dump_scenario(flexneedle.load_scenario("phantom").with_values(QUICK)))
    return path


@pytest.fixture(scope="module")
def complete(scenario, tmp_path_factory):
    """The folder of the same insertion that was not killed."""
    folder = tmp_path_factory.mktemp("complete") / "run"
    assert cli.main(command(scenario, folder)) in (0, 1)
    return folder


@pytest.fixture(scope="module")
def processes():
    context = get_context("forkserver")
    context.set_forkserver_preload(["warm"])
    return context


def command(scenario, folder):
    return [
        "insert",
        str(scenario),
        "--seed",
        "7",
        "--force",
        "--controller",
        "open-loop",
        "--out",
        str(folder),
    ]


def killed_at(processes, scenario, folder, size):
    """Kill a process with this insertion once its trace has so many bytes; return how many periods had ended."""
    made = processes.Value("i", 0)
    process = processes.Process(target=counted, args=(command(scenario, folder), made))
    process.start()
    trace, deadline = folder / "trace.mcap", time.monotonic() + LONGEST_S
    while not (trace.exists() and trace.stat().st_size >= size):
        assert process.is_alive(), "the insertion ended by itself"
        assert time.monotonic() < deadline
        process.join(1e-3)
    os.kill(process.pid, signal.SIGKILL)
    process.join(LONGEST_S)
    assert process.exitcode == -signal.SIGKILL
    return made.value


def rows(folder):
    return [to_row(period) for period in read_trace(folder / "trace.mcap").periods]


def check(folder, complete, made):
    """The record is that of the complete run, up to the period that has ended last, or that was being reported."""
    left, expected = rows(folder), rows(complete)
    assert left == expected[: len(left)]
    assert made <= len(left) <= made + 1
    values = json.loads((folder / "run.json").read_text())
    assert values["status"] == "running"
    with pytest.warns(RuntimeWarning, match="incomplete"):
        loaded = flexneedle.load(folder)
    assert loaded.outcome is Outcome.INTERRUPTED
    assert len(loaded.periods) == len(left)
    return len(left)


@pytest.mark.long
def test_a_kill_at_a_random_moment_loses_no_complete_period(processes, scenario, complete, tmp_path):
    counts, whole = [], (complete / "trace.mcap").stat().st_size
    sizes = np.random.default_rng(0).uniform(0.15, 0.95, TIMINGS) * whole
    for number, size in enumerate(sizes):
        folder = tmp_path / str(number)
        made = killed_at(processes, scenario, folder, size)
        counts.append(check(folder, complete, made))
    assert min(counts) >= 1
    assert len(set(counts)) > 1
