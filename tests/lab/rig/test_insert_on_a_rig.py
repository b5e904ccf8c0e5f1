"""`flexneedle insert --rig`: plan, open the rig, print where the axes are, and ask before anything moves."""

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
STAYS = "flexneedle: the needle stays in place: withdraw it with flexneedle rig retract rig.toml"
REGISTRATION = {
    "rotation": [0.5, 0.5, 0.5, 0.5],
    "translation_mm": [220.0, 0.0, 0.0],
    "fiducials_mm": [[0.0, -40.0, 0.0], [0.0, 40.0, 0.0], [60.0, 0.0, 40.0]],
    "localisation_mm": 0.3,
}


@pytest.fixture
def ends():
    """Options of the fake loop."""
    return {}


@pytest.fixture
def events(monkeypatch, in_tmp, engine, ends):
    """Events in their order: the rig is opened, the user is asked, the needle is inserted."""
    found = []
    engine()
    (in_tmp / "rig.toml").write_text(tomli_w.dumps(values(KINDS | {"registration": REGISTRATION})))

    def inserted(scenario, plan, choices, stream):
        found.append("opened")
        taken = partial(found.append, "signals taken")
        rig = SimpleNamespace(positions=POSITIONS, rig=choices.rig.file, take_signals=taken)
        stream.gate.confirm(rig)
        found.append("inserted")
        return fake_engine.carry_out(scenario, plan, choices, stream, **ends)

    monkeypatch.setattr(recording, "carry_out", inserted)
    return found


@pytest.fixture
def answer(answer, events):
    return partial(answer, asked=partial(events.append, "asked"))


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_to_the_command_interrupts_it(number):
    before = [signal.getsignal(each) for each in SIGNALS]
    with ExitStack() as stack:
        interrupt_on_signals(stack)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_the_axes_of_the_open_rig_are_printed_before_the_question(capsys, events, in_tmp, answer):
    answer("y\n")
    status, out, err = run(capsys, *INSERT)
    assert events == ["opened", "signals taken", "asked", "inserted"]
    lines = ("Planning", "insertion: at 30 mm", "guide_y: at -1.5 mm", "Insert? [y/N]")
    assert sorted(lines, key=err.index) == list(lines)
    assert err.splitlines()[-1] == STAYS
    assert (status, out.split(":")[0]) == (0, "Reached")
    stored = json.loads((in_tmp / "run/run.json").read_text())
    assert stored["scenario"]["tracker"]["registration"] == REGISTRATION


@pytest.mark.parametrize("typed", ["n\n", ""])
def test_an_insertion_that_is_not_confirmed_moves_nothing(capsys, events, in_tmp, answer, typed):
    answer(typed)
    status, _, err = run(capsys, *INSERT)
    assert events == ["opened", "signals taken", "asked"]
    assert status == 1
    assert err.endswith("flexneedle: not confirmed: nothing was moved\n")
    assert json.loads((in_tmp / "run/run.json").read_text())["result"]["outcome"] == "refused"


def test_without_a_terminal_it_is_refused_before_planning(capsys, events, in_tmp, answer):
    answer(None)
    status, _, err = run(capsys, *INSERT)
    assert (status, events) == (2, [])
    assert "use --yes" in err
    assert not (in_tmp / "run").exists()


def test_with_yes_nothing_is_asked_and_after_a_failure_the_needle_stays_in(capsys, events, ends, answer):
    def fail():
        raise RunError("the model has ended")

    answer(None)
    ends["stop"] = 3, fail
    status, _, err = run(capsys, *INSERT, "--yes")
    assert (status, events) == (1, ["opened", "signals taken", "inserted"])
    assert "rotation: at 0 deg" in err
    assert "[y/N]" not in err
    assert STAYS in err


def test_a_dry_run_moves_nothing_and_asks_nothing(capsys, events, in_tmp, answer):
    """The registration of the rig file does not apply to the virtual needle."""
    answer(None)
    status, _, err = run(capsys, *INSERT, "--dry-run")
    assert (status, events) == (0, ["opened", "signals taken", "inserted"])
    assert "[y/N]" not in err
    assert STAYS not in err
    assert "registration" not in json.loads((in_tmp / "run/run.json").read_text())["scenario"]["tracker"]


def test_two_registrations_are_refused(capsys, events, in_tmp):
    (in_tmp / "registration.toml").write_text(tomli_w.dumps({"tracker": {"registration": REGISTRATION}}))
    status, _, err = run(capsys, *INSERT, "--yes", "--registration", "registration.toml")
    assert (status, events) == (2, [])
    assert err.startswith("flexneedle: --registration: ")
