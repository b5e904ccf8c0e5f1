"""On a full disk the needle is held, the motors are stopped, the result is printed, and missing files are named."""

import json
import resource
import signal
from contextlib import contextmanager
from dataclasses import replace

import pytest

import flexneedle
from commands import run
from flexneedle.errors import RecordError
from flexneedle.phantom import kernels
from flexneedle.phantom.phantom import Phantom
from flexneedle.record import saving
from flexneedle.record.folder import Folder
from flexneedle.record.reader import read_trace
from flexneedle.record.writer import TraceWriter
from flexneedle.results import Outcome, Plan
from flexneedle.scenario.files import dump_scenario
from synthetic import make_periods, make_plan

QUICK = {
    "target.depth_mm": 3.0, "target.lateral_mm": 0.0, "plan.samples": 16, "plan.iterations": 2,
    "plan.max_iterations": 2, "needle.nodes": 15, "phantom.element_mm": 5.0, "phantom.contact_spacing_mm": 2.0,
}  # fmt: skip
NO_END = ": no end is recorded: the run was killed, its disk was full, or it is still running"
FULL, TOO_LARGE = "No space left on device", "File too large"
PLAN = make_plan()
PERIODS = list(make_periods(PLAN))[:12]


@contextmanager
def files_up_to(size):
    """No file of this process may become larger (bytes): writing beyond fails as on a full disk."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.getsignal(signal.SIGXFSZ)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.fixture
def motors(monkeypatch):
    """Calls of the driver, in order."""
    calls, apply = [], Phantom.apply

    def applied(phantom, *given):
        calls.append("apply")
        return apply(phantom, *given)

    monkeypatch.setattr(kernels, "compile_kernels", lambda _axes, **_: None)  # moves another phantom
    monkeypatch.setattr(Phantom, "apply", applied)
    monkeypatch.setattr(Phantom, "stop", lambda _phantom: calls.append("stop"))
    return calls


def command(tmp_path, folder, *more):
    path = tmp_path / "quick.toml"
    path.write_text(dump_scenario(flexneedle.load_scenario("phantom").with_values(QUICK)))
    return ("insert", str(path), "--force", "--controller", "open-loop", "--out", str(folder), *more)


@pytest.mark.usefixtures("empty_figures")
def test_a_run_whose_end_cannot_be_written_is_shown_as_one_without_an_end(tmp_path, capsys, monkeypatch):
    def full(_folder, _status, _reason=""):
        raise RecordError("run.json cannot be written")

    folder, reason = tmp_path / "run", NO_END.removeprefix(": ")
    with monkeypatch.context() as patch:
        patch.setattr(Folder, "end", full)
        status, out, err = run(capsys, *command(tmp_path, folder))
    assert (status, out.partition(":")[0]) in ((0, "Reached"), (1, "MISSED"))
    assert "flexneedle: run.json cannot be written" in err
    status, out, err = run(capsys, "view", str(folder))
    assert (status, err) == (0, f"flexneedle: {folder}{NO_END}\n")
    assert out.splitlines() == [str(folder / "insertion.png"), str(folder / "insertion.svg")]
    assert run(capsys, "export", str(folder), "--csv")[2] == f"flexneedle: {folder}{NO_END}\n"
    with pytest.warns(RuntimeWarning, match=reason):
        loaded = flexneedle.load(folder)
    made = read_trace(folder / "trace.mcap").periods
    assert (loaded.outcome, loaded.reason, len(loaded.periods)) == (Outcome.INTERRUPTED, reason, len(made))
    assert (
        loaded.summary == f"interrupted {made[-1].estimate.x:.1f} mm deep after {len(made)} periods: {reason}"
    )


@pytest.mark.usefixtures("empty_figures")
def test_plans_without_a_recorded_end_are_loaded_with_a_warning(tmp_path):
    plan = replace(PLAN, scenario=flexneedle.load_scenario("phantom"))
    path = flexneedle.save(plan, tmp_path / "plan") / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"status": "running"}))
    with pytest.warns(RuntimeWarning, match=f"^{path.parent}{NO_END}$"):
        assert isinstance(flexneedle.load(path.parent), Plan)


@pytest.mark.usefixtures("empty_figures")
def test_without_room_for_the_trace_the_needle_is_held_and_the_record_has_the_outcome(
    tmp_path, capsys, motors
):
    arguments = command(tmp_path, tmp_path / "run", "--json")
    with files_up_to(150_000):
        status, out, err = run(capsys, *arguments)
    result, reason = json.loads(out), f"trace.mcap cannot be written: {TOO_LARGE}"
    assert (status, result["outcome"], result["reason"]) == (1, "held", reason)
    assert (motors[-1], motors.count("stop"), motors.count("apply")) == ("stop", 1, result["steps"])
    stored = json.loads((tmp_path / "run/run.json").read_text())
    assert (stored["status"], stored["reason"]) == ("held", reason)
    assert "run.json" not in err
    assert "Traceback" not in err
    with pytest.warns(RuntimeWarning, match="incomplete"):
        loaded = flexneedle.load(tmp_path / "run")
    assert (loaded.outcome, len(loaded.periods)) == (Outcome.HELD, motors.count("apply") - 1)


@pytest.mark.usefixtures("empty_figures")
def test_a_disk_that_is_full_from_the_start_moves_nothing(tmp_path, capsys, motors):
    arguments = command(tmp_path, tmp_path / "run")
    with files_up_to(4000):
        status, out, err = run(capsys, *arguments)
    assert (status, out, motors) == (1, "", [])
    assert f"run.json cannot be written: {TOO_LARGE}" in err


@pytest.mark.usefixtures("empty_figures")
def test_an_index_that_cannot_be_written_is_named_and_the_result_stays(tmp_path, capsys, monkeypatch):
    def full(writer):
        with writer._writing():
            raise OSError(28, FULL)

    arguments = command(tmp_path, tmp_path / "run")
    monkeypatch.setattr(TraceWriter, "close", lambda writer: None if writer._file.closed else full(writer))
    status, out, err = run(capsys, *arguments)
    assert status == 1
    assert out.startswith(("Reached", "MISSED"))
    assert f"flexneedle: trace.mcap cannot be written: {FULL}" in err
    assert len(read_trace(tmp_path / "run/trace.mcap").periods) >= 30


def test_a_figure_that_cannot_be_drawn_is_named_and_the_result_stays(tmp_path, capsys, monkeypatch):
    def broken(*_):
        raise ValueError("Axis limits cannot be NaN or Inf")

    monkeypatch.setattr(saving, "draw_run", broken)
    arguments = command(tmp_path, tmp_path / "run", "--json")
    status, out, err = run(capsys, *arguments)
    result = json.loads(out)
    assert (status, result["outcome"]) == (int(not result["reached"]), "done")
    assert "flexneedle: figures cannot be drawn: ValueError: Axis limits cannot be NaN or Inf\n" in err
    assert json.loads((tmp_path / "run/run.json").read_text())["status"] == "done"


def write(path, periods=PERIODS):
    with TraceWriter(path, PLAN, about={"seed": "0"}, scenario={}) as writer:
        for period in periods:
            writer.add(period)
    return path.stat().st_size


@pytest.mark.parametrize("share", [0.2, 0.95])
def test_a_trace_keeps_the_periods_before_the_one_that_does_not_fit(tmp_path, share):
    size = write(tmp_path / "whole.mcap")
    with (
        files_up_to(int(share * size)),
        pytest.raises(RecordError, match=f"trace.mcap cannot be written: {TOO_LARGE}"),
    ):
        write(tmp_path / "trace.mcap")
    left = read_trace(tmp_path / "trace.mcap")
    assert abs(len(left.periods) - share * len(PERIODS)) <= 2.0
    assert "incomplete" in left.note


def test_a_trace_without_its_beginning_is_removed_and_a_failed_writer_is_closed(tmp_path):
    with files_up_to(1000), pytest.raises(RecordError):
        write(tmp_path / "trace.mcap")
    assert not (tmp_path / "trace.mcap").exists()
    writer = TraceWriter(tmp_path / "trace.mcap", PLAN, about={"seed": "0"}, scenario={})
    with files_up_to(1000), pytest.raises(RecordError):
        writer.add(PERIODS[0])
    writer.close()
    with pytest.raises(ValueError, match="closed"):
        writer.add(PERIODS[0])


def test_save_names_a_file_that_cannot_be_written(tmp_path, monkeypatch):
    def full(*_):
        raise RecordError(f"insertion.png cannot be written: {FULL}")

    monkeypatch.setattr(saving, "draw_run", full)
    scenario = flexneedle.load_scenario("phantom")
    record = flexneedle.Insertion(PLAN, 0, (), Outcome.FAILED, "none", scenario=scenario)
    with pytest.raises(RecordError, match=r"insertion\.png cannot be written"):
        flexneedle.save(record, tmp_path / "run")
