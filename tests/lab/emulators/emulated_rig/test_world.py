"""The phantom's process without processes: records of the motors in, records of the tip and true states out."""

import socket
from time import monotonic

import numpy as np
import pytest

from flexneedle.lab.emulators.emulated_rig import phantom
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.phantom import EmulatedPhantom
from flexneedle.lab.emulators.emulated_rig.stream import Record
from flexneedle.lab.emulators.emulated_rig.truth import TruthWriter, read_truth
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.rig_file import load_rig
from flexneedle.scenario.files import load_scenario

RIG = load_rig("emulated")
AXES = tuple(name for name, _ in RIG.axes.items())


@pytest.fixture
def world(tmp_path):
    """A world, the reading end of what it sends, the file of its true states, and its notes."""
    reading, sending = map(MessageChannel, socket.socketpair())
    path, notes = tmp_path / "truth.csv", []
    with TruthWriter(path, AXES) as writer:
        yield (
            EmulatedPhantom(EmulationJob(RIG, load_scenario("phantom"), 3), sending, writer, notes.append),
            reading,
            path,
            notes,
        )
    reading.close()
    sending.close()


def test_each_record_of_the_motors_is_one_of_the_tip_at_the_same_time(world):
    """And a row of the true states, with the tip and the axes that belong to it."""
    moving, seen, path, _ = world
    now = monotonic()
    moving.follow(Record(now - 0.01, (0.0, 0.0, 0.0, 0.0), False))
    moving.follow(Record(now - 0.005, (0.0, 0.0, 0.0, 0.0), True))
    moving.follow(Record(now, (4000.0, 9000.0, 200.0, -100.0), True))
    records, truth = seen.receive(), read_truth(path)
    sent = [(record.time, record.moving) for record in records]
    assert sent == [(now - 0.01, False), (now - 0.005, True), (now, True)]
    np.testing.assert_allclose(truth.time, [record.time for record in records], atol=1e-6)
    # The registration of this rig: the tracker's z is x, its x is y, its y is z.
    on_stage = [(z + 220.0, x, y) for x, y, z, *_ in (record.values for record in records)]
    np.testing.assert_allclose(truth.tips[:, :3], on_stage, atol=1e-6)
    assert truth.tips[2, 0] - truth.tips[0, 0] == pytest.approx(2.0, abs=5e-3)
    assert {name: place[2] for name, place in truth.positions.items()} == pytest.approx(
        {"insertion": 2.0, "rotation": np.pi / 2, "guide_y": 0.1, "guide_z": -0.05}
    )
    assert [truth.counts[name][2] for name in AXES] == [4000.0, 9000.0, 200.0, -100.0]
    assert truth.converged.all()


def test_the_lag_is_the_age_of_a_record_when_it_has_been_followed(world, monkeypatch):
    moving, _, path, notes = world
    monkeypatch.setattr(phantom, "monotonic", lambda: 100.25)
    for _ in range(3):
        moving.follow(Record(100.0, (0.0,) * 4, True))
    assert read_truth(path).lag.tolist() == [0.25] * 3
    assert notes == ["the phantom is 250 ms behind the motors"]
    assert moving.summary()["lag_max_ms"] == pytest.approx(250.0)


def test_a_needle_without_equilibrium_is_reported_once(world, monkeypatch):
    moving, _, path, notes = world
    monkeypatch.setattr(phantom.DrivenNeedle, "converged", False)
    for _ in range(2):
        moving.follow(Record(monotonic(), (0.0,) * 4, False))
    assert notes == ["the phantom did not converge: its tip is not to be trusted"]
    assert read_truth(path).converged.tolist() == [0.0, 0.0]
