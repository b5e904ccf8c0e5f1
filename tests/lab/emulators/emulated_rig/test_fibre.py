"""The fibre of an emulated rig without processes: shapes in, frames out, and the rig file of its driver."""

import math
import socket

import numpy as np
import pytest

from flexneedle.errors import InputError, RigError
from flexneedle.lab.emulators.emulated_rig.emulated_rig import check_free, rig_values
from flexneedle.lab.emulators.emulated_rig.fibre_part import address_of_fibre, section_of, to_bends
from flexneedle.lab.emulators.emulated_rig.following import NeedleHistory
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob, make_job
from flexneedle.lab.emulators.emulated_rig.phantom import EmulatedPhantom
from flexneedle.lab.emulators.emulated_rig.stream import Record
from flexneedle.lab.emulators.fbgs import FbgsSession, encode_frame
from flexneedle.lab.process import MessageChannel
from flexneedle.lab.rig.devices.fbg.fbgs import FbgsSettings, FrameReader
from flexneedle.lab.rig.devices.fbg.stream import FrameDecoder
from flexneedle.lab.rig.rig_file import RigFile, check_settings, load_rig
from flexneedle.loop.virtual import Seeds, virtual_rig, virtual_sensors
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.types import Control

RIG = load_rig("emulated")
SITES = (11.0, 26.0, 70.0)
QUIET = {"noise_per_m": 1e-6, "phantom": {"missing_fraction": 0.0, "clock_s": 0.03}}


def with_fibre(**values):
    fibre = {"kind": "fbg", "sites_mm": list(SITES), **values}
    return load_scenario("phantom3d").with_values({"sensor": [fibre], "setup.max_rotation_deg": 720.0})


@pytest.fixture
def channels():
    """Both ends of a channel for the tip, and of one for the shapes."""
    ends = [MessageChannel(end) for _ in range(2) for end in socket.socketpair()]
    yield ends
    for end in ends:
        end.close()


def test_the_fibre_measures_what_it_measures_in_insert_with_the_same_seed(channels):
    """After advances with the guide and rolls by more than half a turn; errors of the draw included."""
    scenario = with_fibre(**QUIET)
    job, virtual = EmulationJob(RIG, scenario, 3), virtual_rig(scenario, 0.0, Seeds.of(3))
    for roll in (*(0.0,) * 40, 2.0, 2.0):
        virtual.driver.apply(Control(db_x=1.0, dg_y=0.1, roll=roll), 0.2)
    virtual.clock.wait(0.5)
    expected = virtual.sensors["fbg"].read()[-1]
    _, to_tip, shapes, to_fibre = channels
    world = EmulatedPhantom(job, to_tip, None, print, to_fibre)
    world.begin()
    (first,) = shapes.receive()
    needle = NeedleHistory(first.time, first, clock=lambda: first.time + 9.0)
    scale, turn, guide = (getattr(RIG.axes, name).scale for name in ("insertion", "rotation", "guide_y"))
    for k in range(1, 43):
        for advance in (k - 1, k):  # the roll comes first
            travel = (advance * scale, max(0, k - 40) * 2.0 * turn, 0.1 * advance * guide, 0.0)
            world.follow(Record(first.time + 0.2 * k + 0.1 * (advance - k), travel, False))
        needle.add(shapes.receive())
    found = virtual_sensors(scenario, needle, Seeds.of(3))["fbg"].read()[-1]
    assert np.abs(expected.rows).max() > 1.5e-4
    np.testing.assert_allclose(found.rows, expected.rows, atol=4e-6)
    assert found.time - expected.time == pytest.approx(9.0 - virtual.clock.now(), abs=0.011)


def test_between_records_the_shape_is_between_them_and_later_it_rests():
    """The roll turns on over half a turn. A slow clock makes readings late, and moves no shape."""
    straight = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    now = [100.25]
    needle = NeedleHistory(100.0, Record(100.0, (3.0, *straight.ravel()), True), lambda: now[0])
    needle.add([Record(100.1, (-3.0, *(straight + np.array([0.5, 0.2, 0.0])).ravel()), False)])
    needle.late = 0.05
    assert needle.now() == pytest.approx(0.2)
    poses, roll = needle.shape_at(0.05)
    np.testing.assert_allclose(poses[:, :3], straight + np.array([0.25, 0.1, 0.0]))
    assert roll == pytest.approx(math.pi)
    assert needle.tip_at(5.0) == pytest.approx((1.5, 0.2, 0.0))


@pytest.mark.parametrize("sites", [SITES, (20.0,)])
@pytest.mark.parametrize("axes", [1, 2])
def test_the_driver_reads_the_values_of_the_sites(sites, axes):
    fibre = Fbg(kind="fbg", sites_mm=sites)
    section = section_of(fibre, "127.0.0.1:50012")
    settings = check_settings(
        FbgsSettings, {key: section[key] for key in section if key not in {"name", "kind"}}
    )
    rows = tuple((1e-3 * (k + 1), -2e-3)[:axes] for k in range(len(sites)))
    reader, decoder = FrameReader(settings, fibre), FrameDecoder()
    sent = [encode_frame(n, 0.01 * n, to_bends(one, len(sites))) for n, one in enumerate((rows, ()), start=1)]
    measured, missing = (reader.read(decoder.feed(one), n)[0] for n, one in enumerate(sent))
    np.testing.assert_allclose(np.array(measured.rows)[:, :axes], rows, rtol=1e-6)
    assert (missing.rows, missing.status) == ((), "no value is valid")


def test_without_new_curvatures_no_frame_is_sent():
    found = [np.zeros((2, 3)), None, np.ones((2, 3))]
    session = FbgsSession((), 0.0, curvatures=lambda _now: found.pop(0), rate_hz=20.0)
    sent = [session.take_due(now) for now in (0.051, 0.07, 0.101, 0.151)]
    assert [len(frames) for frames in sent] == [1, 0, 0, 1]


def test_the_saved_rig_file_has_the_addresses_and_can_be_emulated_again(tmp_path):
    job = EmulationJob(RIG, with_fibre())
    values = rig_values(job, {"galil": "127.0.0.1:7", "aurora": "/tmp/a", "fbgs": "127.0.0.1:8"})
    rig = RigFile.model_validate(values)
    assert (rig.driver.settings["address"], rig.tracker.settings["port"]) == ("127.0.0.1:7", "/tmp/a")
    assert (rig.axes, rig.registration) == (RIG.axes, RIG.registration)
    assert address_of_fibre(RIG, job.fibre) == ("127.0.0.1", 0)
    assert address_of_fibre(rig, job.fibre) == ("127.0.0.1", 8)
    assert rig_values(EmulationJob(rig, with_fibre()), {"galil": "", "aurora": "", "fbgs": "a:9"})[
        "sensor"
    ] == [{**values["sensor"][0], "host": "a", "port": 9}]
    with pytest.raises(RigError, match=r"positions_mm = \[20.0, 30.0\], first = 3"):
        address_of_fibre(rig, Fbg(kind="fbg", sites_mm=(20.0, 30.0)))
    (tmp_path / "rig.toml").write_text("")
    with pytest.raises(InputError, match=r"rig\.toml: already exists"):
        check_free(EmulationJob(free(tmp_path), with_fibre(), save=tmp_path / "rig.toml"))


def free(folder):
    values = RIG.model_dump(mode="json", exclude_unset=True)
    values["driver"]["address"], values["tracker"]["port"] = "127.0.0.1:0", str(folder / "aurora")
    return RigFile.model_validate(values)


def test_a_fault_of_a_fibre_that_is_not_there_and_two_fibres_are_refused():
    with pytest.raises(InputError, match="has no sensor of kind fbg"):
        make_job(RIG, load_scenario("phantom"), None, 0, None, (("fbgs", "unplug@1"),))
    two = [{"kind": "fbg", "name": name, "sites_mm": [20.0]} for name in "ab"]
    with pytest.raises(InputError, match="one sensor of kind fbg"):
        make_job(RIG, load_scenario("phantom").with_values({"sensor": two}), None, 0, None, ())
