"""The sensor `fbgs`: gratings to sites, times of readings, and an emulated device that fails."""

import math
import socket
from contextlib import ExitStack
from itertools import pairwise
from threading import Event, Thread
from time import monotonic

import numpy as np
import pytest

from emulated import until
from flexneedle.errors import DriverError, RigError
from flexneedle.lab.emulators.faults import parse_fault
from flexneedle.lab.emulators.fbgs import FAULTS, POSITIONS_MM, FbgsServer, FbgsSession, advance, encode_frame
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.lab.rig.devices.fbg.fbgs import FbgsSensor, FbgsSettings, FrameReader, make_sensor
from flexneedle.lab.rig.devices.fbg.stream import FibreFrame, FrameDecoder
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.testing import NeedleSensorConformance
from rooms import ManualClock

SENSOR = Fbg(kind="fbg", sites_mm=(20.0, 35.0, 105.0), delay_s=0.02, rate_hz=100.0)


def settings(**values):
    given = {"host": "127.0.0.1", "positions_mm": list(POSITIONS_MM), "first": 3, "late_ms": 100, **values}
    return check_settings(FbgsSettings, given)


def frame(line=1, curvature=(), angle=(), **values):
    arrays = np.array(curvature, float), np.array(angle, float)
    return FibreFrame(
        **{"fibre": 0, "error": 0, "line": line, "stamp": 0.01 * line, **values},
        **dict(zip(("curvature", "angle"), arrays, strict=True)),
    )


def rows(sites, curvature, angle, **values):
    """Return the rows of a reading at the sites, of gratings at 40, 30, 20 and 10 mm."""
    device = settings(**{"positions_mm": [40, 30, 20, 10], "first": 1, **values})
    reader = FrameReader(device, Fbg(kind="fbg", sites_mm=sites))
    (reading,) = reader.read([frame(1, curvature, angle)], 1.0)
    return np.array(reading.rows)


# Gratings to sites


def test_a_site_at_a_grating_has_its_curvature_and_another_the_mean_by_distance():
    found = rows((10.0, 22.5, 40.0), [0.004, 0.003, 0.002, 0.001], [0.0, math.pi / 2, math.pi, 0.0])
    between = 0.75 * np.array([-0.002, 0.0]) + 0.25 * np.array([0.0, 0.003])
    np.testing.assert_allclose(found, [[0.001, 0.0], between, [0.004, 0.0]], atol=1e-12)


def test_turn_mirror_and_gain_change_the_curvature_in_their_order():
    """κ e^(i(±α + turn)) · gain."""
    found = rows((20.0,), [0.001] * 4, [0.3] * 4, turn_deg=45.0, mirrored=True, gain=1.1)
    angle = -0.3 + math.radians(45.0)
    np.testing.assert_allclose(found[0], [0.0011 * math.cos(angle), 0.0011 * math.sin(angle)], rtol=1e-9)


def test_a_grating_without_value_leaves_the_sites_between_others():
    found = rows((10.0, 20.0, 25.0, 40.0), [0.001, np.nan, 0.001, 0.001], [0.0] * 4)
    np.testing.assert_array_equal(np.isnan(found[:, 0]), [False, False, True, False])


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"positions_mm": [40, 30, 30]}, r"positions_mm = \[40, 30, 30\]: "),
        ({"positions_mm": [90, 30]}, r"sites_mm = 20.0: "),
        ({"hosts": "a"}, r'hosts = "a": '),
    ],
)
def test_settings_that_do_not_fit_are_refused(values, line):
    with pytest.raises(RigError, match=line):
        FrameReader(settings(**values), SENSOR)


# Readings


def test_frames_that_arrive_together_are_spread_since_the_ones_before():
    reader, values = FrameReader(settings(), SENSOR), ([0.001] * 20, [0.0] * 20)
    first = reader.read([frame(1, *values)], 5.0)
    later = reader.read([frame(2, *values), frame(3, *values)], 5.012)  # 6 ms: below the period
    last = reader.read([frame(4, *values), frame(5, *values)], 6.0)  # the period
    times = [one.time for one in first + later + last]
    assert times == pytest.approx([4.98, 4.986, 4.992, 5.97, 5.98])


def test_a_repeated_frame_is_no_reading_but_one_with_an_error_is_one_with_its_reason():
    reader, values = FrameReader(settings(), SENSOR), ([0.001] * 20, [0.0] * 20)
    assert len(reader.read([frame(1, *values)] * 2, 1.0)) == 1
    assert reader.read([frame(1, *values)], 1.01) == []
    assert reader.status == "line and timestamp do not change"
    for one, status in (
        (frame(2, *values, error=4), "error 4"),
        (frame(3, [0.001] * 19, [0.0] * 19), "19 values in the stream, first and positions_mm need 20"),
        (frame(4, [np.nan] * 20, [0.0] * 20), "no value is valid"),
    ):
        (reading,) = reader.read([one], 2.0 + one.line)
        assert (reading.rows, reading.status) == ((), status)


def test_frames_of_another_fibre_are_skipped():
    reader = FrameReader(settings(fibre=2), SENSOR)
    assert reader.read([frame(1, [0.001] * 20, [0.0] * 20)], 1.0) == []
    assert reader.status == "the stream has fibre 0, not 2"


# The emulated device


class EmulatedDevice:
    """A device in a thread. Faults are orders, such as `fault unplug`."""

    def __init__(self, *faults):
        self._tcp, self._end = FbgsServer("127.0.0.1", 0), Event()
        self._session = FbgsSession([parse_fault(one, FAULTS) for one in faults], monotonic())

    def __enter__(self):
        self._tcp.plug()
        self._thread = Thread(target=self._run)
        self._thread.start()
        return self

    def __exit__(self, *_exception):
        self._end.set()
        self._thread.join()
        self._tcp.unplug()

    def _run(self):
        while not self._end.is_set():
            advance(self._session, self._tcp, monotonic(), lambda _: None)
            self._tcp.receive_lines(0.002, deaf=False)

    def order(self, line):
        self._session.schedule.obey(line, monotonic())

    def sensor(self, clock=None, **values):
        return FbgsSensor(settings(port=self._tcp.address[1], **values), clock or WallClock(), SENSOR)


@pytest.fixture
def connected(monkeypatch):
    """A device and a sensor of it that connects again at once."""
    monkeypatch.setattr("flexneedle.lab.rig.devices.fbg.fbgs._RETRY_S", 0.01)
    monkeypatch.setattr("flexneedle.lab.rig.devices.fbg.fbgs._SILENT_S", 0.2)
    with EmulatedDevice() as device:
        sensor = device.sensor()
        until(sensor.read)
        yield device, sensor
        sensor.close()


def test_it_has_the_curvatures_of_the_device_at_their_times(connected):
    _, sensor = connected
    readings = [one for _ in range(10) for one in until(sensor.read)]
    assert all(later.time > earlier.time for earlier, later in pairwise(readings))
    sizes = [math.hypot(*row) for one in readings for row in one.rows]
    assert sizes == pytest.approx([2.5e-3] * len(sizes), rel=1e-5)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("unplug", "Connection refused"),
        ("silence", "the device sends nothing"),
        ("frozen", "line and timestamp do not change"),
        ("cut", ""),
    ],
)
def test_a_device_that_stops_is_reported_and_read_again(connected, fault, reason):
    device, sensor = connected
    device.order(f"fault {fault}")
    until(lambda: reason in sensor.status and sensor.status.startswith("no reading for "))
    sensor.read()
    assert sensor.read() == ()
    device.order("clear")
    until(sensor.read)
    assert sensor.status == "ok"


@pytest.mark.parametrize(("fault", "status"), [("error=5", "error 5"), ("nan", "ok")])
def test_values_that_are_not_valid_are_not_read(connected, fault, status):
    device, sensor = connected
    device.order(f"fault {fault}")
    readings = until(lambda: [one for one in sensor.read() if fault == "nan" or not one.rows])
    assert readings[-1].status == status


def lines_of(client, count, flush=lambda: None):
    """Return the numbers of the next frames of a connection; flush: called before more is received."""
    decoder, found = FrameDecoder(), []
    while len(found) < count:
        flush()
        found += [one.line for one in decoder.feed(client.recv(1 << 16))]
    assert decoder.refused == decoder.skipped == ""
    return found


def test_four_clients_get_every_frame_and_one_that_does_not_read_loses_whole_ones():
    with FbgsServer("127.0.0.1", 0) as server, ExitStack() as stack:
        clients = [stack.enter_context(socket.create_connection(server.address)) for _ in range(5)]
        while len(server.clients) < 5:
            server.receive_lines(0.1, deaf=False)
        for line in range(1, 601):  # 9 MB: more than the buffers of a connection have
            server.send(encode_frame(line, 0.0, np.zeros((2, 18))))
            assert [lines_of(one, 1) for one in clients[:4]] == [[line]] * 4
        found = lines_of(clients[4], 50, lambda: server.send(b""))
        assert all(later > earlier for earlier, later in pairwise(found))


class TestFbgs(NeedleSensorConformance):
    """The sensor of an emulated device."""

    seconds, least_hz = 0.3, 80.0

    def make(self, clock):
        self.device = EmulatedDevice().__enter__()
        return self.device.sensor(clock)

    def disconnect(self, sensor):
        self.device.order("fault unplug")
        until(lambda: sensor.status != "ok")

    def teardown_method(self):
        self.device.__exit__()


def test_a_device_that_cannot_be_reached_is_an_error_in_one_line():
    with pytest.raises(DriverError, match=r"^127.0.0.1:1: no connection: Connection refused; check "):
        make_sensor({"host": "127.0.0.1", "port": 1, "positions_mm": [10, 120]}, ManualClock(), SENSOR)
