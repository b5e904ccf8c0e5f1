"""`flexneedle insert --rig`: it plans, opens the rig, shows where the axes are, and asks before anything moves."""

import json
import signal
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace

import pytest
import tomli_w

import fake_engine
from bench_rig import values
from commands import run
from flexneedle.errors import RunError
from flexneedle.interrupts import SIGNALS
from flexneedle.lab.commands.insert import interrupt_on_signals
from flexneedle.record import recording

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")

KINDS = {"driver.kind": "bench_rig:drivers", "tracker.kind": "bench_rig:trackers"}
POSITIONS = {"insertion": 30.0, "rotation": 0.0, "guide_y": -1.5}
INSERT = ("insert", "phantom", "--rig", "rig.toml", "--out", "run")


@pytest.fixture
def events(monkeypatch, in_tmp, engine, ends):
    """What happens, in order: the plan, the rig that is opened, the needle that is inserted."""
    found = []
    engine()
    (in_tmp / "rig.toml").write_text(tomli_w.dumps(values(KINDS)))

    def inserted(scenario, plan, choices, stream):
        found.append("opened")
        taken = partial(found.append, "signals taken")
        rig = SimpleNamespace(positions=POSITIONS, rig=choices.rig.file, take_signals=taken)
        stream.gate.confirm(rig)
        found.append("inserted")
        return fake_engine.carry_out(scenario, plan, choices, stream, **ends)

    monkeypatch.setattr(recording, "carry_out", inserted)
    return found


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_to_the_command_interrupts_it(number):
    before = [signal.getsignal(each) for each in SIGNALS]
    with ExitStack() as stack:
        interrupt_on_signals(stack)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert [signal.getsignal(each) for each in SIGNALS] == before


@pytest.fixture
def ends():
    """Options of the fake loop."""
    return {}


def types(monkeypatch, answer, found):
    def readline():
        found.append("asked")
        return answer

    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True, readline=readline))


def test_the_axes_of_the_open_rig_are_shown_before_the_question(capsys, monkeypatch, events):
    types(monkeypatch, "y\n", events)
    status, out, err = run(capsys, *INSERT)
    assert events == ["opened", "signals taken", "asked", "inserted"]
    assert err.index("Planning") < err.index("insertion: at 30 mm, moves at most at 10 mm/s")
    assert "guide_y: at -1.5 mm, moves at most at 5 mm/s" in err
    assert err.index("guide_y: at") < err.index("Insert? [y/N]")
    assert status == 0
    assert out.startswith("Reached")


@pytest.mark.parametrize("answer", ["n\n", "\n", ""])
def test_an_insertion_that_is_not_confirmed_moves_nothing(capsys, monkeypatch, events, in_tmp, answer):
    types(monkeypatch, answer, events)
    status, _, err = run(capsys, *INSERT)
    assert events == ["opened", "signals taken", "asked"]
    assert status == 1
    assert err.endswith("flexneedle: not confirmed: nothing was moved\n")
    stored = json.loads((in_tmp / "run/run.json").read_text())
    assert stored["result"]["outcome"] == "refused"


def test_without_a_terminal_it_is_refused_before_planning(capsys, monkeypatch, events, in_tmp):
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: False))
    status, _, err = run(capsys, *INSERT)
    assert (status, events) == (2, [])
    assert "no terminal to confirm the motion on: use --yes to move without asking" in err
    assert not (in_tmp / "run").exists()


def test_with_yes_the_axes_are_shown_and_nothing_is_asked(capsys, events):
    status, _, err = run(capsys, *INSERT, "--yes")
    assert (status, events) == (0, ["opened", "signals taken", "inserted"])
    assert "rotation: at 0 deg, moves at most at 360 deg/s" in err
    assert "[y/N]" not in err


@pytest.mark.parametrize("outcome", ["done", "held", "failed", "interrupted"])
def test_where_the_needle_is_left_in_the_command_that_withdraws_it_is_named(capsys, events, ends, outcome):
    ends["outcome"] = outcome
    _, _, err = run(capsys, *INSERT, "--yes")
    line = "flexneedle: the needle stays where it is: withdraw it by flexneedle rig retract rig.toml"
    assert events[-1] == "inserted"
    assert err.splitlines()[-1] == line
    _, _, err = run(capsys, *INSERT[:-1], "dry", "--dry-run")
    assert line not in err


def test_an_error_after_the_first_motion_leaves_the_needle_in(capsys, events, ends):
    def broken():
        raise RunError("the model has ended")

    ends["stop"] = 3, broken
    status, _, err = run(capsys, *INSERT, "--yes")
    assert (status, events[-1]) == (1, "inserted")
    assert "flexneedle: the needle stays where it is: withdraw it by" in err


def test_a_dry_run_moves_nothing_and_asks_nothing(capsys, monkeypatch, events):
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: False))
    status, _, err = run(capsys, *INSERT, "--dry-run")
    assert (status, events) == (0, ["opened", "signals taken", "inserted"])
    assert "[y/N]" not in err


REGISTRATION = {
    "rotation": [0.5, 0.5, 0.5, 0.5],
    "translation_mm": [220.0, 0.0, 0.0],
    "fiducials_mm": [[0.0, -40.0, 0.0], [0.0, 40.0, 0.0], [60.0, 0.0, 40.0]],
    "localisation_mm": 0.3,
}


@pytest.mark.parametrize("dry", [False, True])
def test_the_registration_of_the_rig_file_is_recorded_where_it_is_used(capsys, events, in_tmp, dry):
    (in_tmp / "rig.toml").write_text(tomli_w.dumps(values(KINDS | {"registration": REGISTRATION})))
    status, out, _ = run(capsys, *INSERT, *(["--dry-run"] if dry else ["--yes"]))
    assert (status, "inserted" in events) == (0, True)
    assert ("expected registration error" in out) is not dry
    stored = json.loads((in_tmp / "run/run.json").read_text())["scenario"]["tracker"].get("registration")
    assert stored == (None if dry else REGISTRATION)


def test_two_registrations_are_refused(capsys, events, in_tmp):
    (in_tmp / "rig.toml").write_text(tomli_w.dumps(values(KINDS | {"registration": REGISTRATION})))
    (in_tmp / "registration.toml").write_text(tomli_w.dumps({"tracker": {"registration": REGISTRATION}}))
    status, _, err = run(capsys, *INSERT, "--yes", "--registration", "registration.toml")
    assert (status, events) == (2, [])
    assert err == (
        "flexneedle: --registration: not with a rig whose file has a section [registration]: remove one\n"
    )
