"""Curvatures from wavelengths, against closed forms of bent needles with gratings, and the file of a calibration."""

import json
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from flexneedle.errors import DriverError, InputError, RigError
from flexneedle.lab.rig.devices.fbg.calibration import read_calibration
from flexneedle.lab.rig.devices.fbg.interrogator import make_sensor
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.slice import Slice
from rooms import ManualClock

LENGTH, PLACES = 165.0, (65.0, 100.0, 135.0, 155.0)  # mm, from the base
RADIUS = 0.3  # mm, of the fibres from the axis
WAVELENGTHS = np.array([[1540.0 + 5.0 * n + k for n in range(4)] for k in range(3)])  # nm, (channels, sites)
STRAIN_OPTIC, EXPANSION, THERMO_OPTIC = 0.22, 0.55e-6, 8.6e-6
SENSOR = Fbg(kind="fbg", sites_mm=(10.0, 30.0, 65.0, 100.0), delay_s=0.02)


def wavelengths(
    kappa, axial=0.0, warmer=0.0, angles=(0.0, 2.0 * math.pi / 3, 4.0 * math.pi / 3), radius=RADIUS
):
    """Bragg wavelengths (channels · sites), nm, of curvatures (sites, 2), 1/mm; axial strain and temperature for all.

    ε = axial - r (κy cos φ + κz sin φ) of a fibre at the angle φ: compressed on the side to which the needle bends.
    Δλ = λ ((1 - p_e) ε + (α_Λ + α_n) ΔT).
    """
    fibres = np.column_stack([np.cos(angles), np.sin(angles)])
    strain = axial - radius * fibres @ np.asarray(kappa).T
    shift = (1.0 - STRAIN_OPTIC) * strain + (EXPANSION + THERMO_OPTIC) * warmer
    return (WAVELENGTHS * (1.0 + shift)).ravel()


def matrix(site):
    """Calibration of a site: the inverse of the shifts of unit curvatures, mean over fibres subtracted."""
    unit = [wavelengths(np.tile(one, (4, 1))) - wavelengths(np.zeros((4, 2))) for one in np.eye(2)]
    shifts = np.array([one.reshape(3, 4)[:, site] for one in unit]).T
    return np.linalg.pinv(shifts - shifts.mean(axis=0)).tolist()


def values(**changes):
    """Return the content of a calibration file."""
    places = {str(place): place for place in PLACES}
    return {
        "serial number": "3CH-4AA-0001",
        "length": LENGTH,
        "# channels": 3,
        "# active areas": 4,
        "Sensor Locations": {str(n): place for n, place in enumerate(PLACES, 1)},
        "Calibration Matrices": {key: matrix(n) for n, key in enumerate(places)},
        "weights": dict.fromkeys(places, 1.0),
        "Emod": None,
    } | changes


@pytest.fixture
def file(tmp_path):
    """Return a function that writes a calibration and returns its path."""

    def write(**changes):
        path = tmp_path / "needle.json"
        path.write_text(json.dumps(values(**changes)))
        return path

    return write


KAPPA = np.array([[0.002, -0.001], [0.0, 0.003], [-0.0015, 0.0], [0.001, 0.001]])


@pytest.mark.parametrize(("axial", "warmer"), [(0.0, 0.0), (2e-4, 0.0), (0.0, 15.0), (-1e-4, -20.0)])
def test_curvatures_come_back_whatever_temperature_and_axial_strain(file, axial, warmer):
    """The mean over the fibres leaves only what differs with λ: 0.1 % of the common shift."""
    calibration = read_calibration(file())
    bends = calibration.to_bends(wavelengths(KAPPA, axial, warmer) - wavelengths(0.0 * KAPPA))
    np.testing.assert_allclose(bends, KAPPA[:, 0] + 1j * KAPPA[:, 1], atol=2e-6)
    assert calibration.positions == (100.0, 65.0, 30.0, 10.0)


def test_temperature_alone_bends_nothing(file):
    shifts = wavelengths(0.0 * KAPPA, warmer=20.0) - wavelengths(0.0 * KAPPA)
    assert np.abs(shifts).min() > 0.27  # nm
    assert np.abs(read_calibration(file()).to_bends(shifts)).max() < 1.5e-6  # 1/mm; 0.28 nm are 0.0016


def test_a_fibre_in_the_axis_is_the_reference(file):
    """Its shift is of temperature and axial strain only; the others need not be around the axis."""
    angles, radii = (0.0, 0.0, math.pi / 2), np.array([0.0, RADIUS, RADIUS])

    def bent(kappa, warmer=0.0):
        fibres = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        shift = (STRAIN_OPTIC - 1.0) * fibres @ np.asarray(kappa).T + (EXPANSION + THERMO_OPTIC) * warmer
        return (1550.0 * (1.0 + shift)).ravel()

    scale = -1.0 / (1550.0 * (1.0 - STRAIN_OPTIC) * RADIUS)
    matrices = {str(place): [[0.0, scale, 0.0], [0.0, 0.0, scale]] for place in PLACES}
    calibration = read_calibration(file(**{"Calibration Matrices": matrices, "Central Core CH": 1}))
    bends = calibration.to_bends(bent(KAPPA, 12.0) - bent(0.0 * KAPPA))
    np.testing.assert_allclose(bends, KAPPA[:, 0] + 1j * KAPPA[:, 1], rtol=1e-9)


def test_a_site_without_weight_is_not_used(file):
    weights = {"65.0": 1.0, "100.0": 0.0, "135.0": 0.5, "155.0": 1.0}
    calibration = read_calibration(file(weights=weights))
    assert (calibration.positions, calibration.signals) == ((100.0, 30.0, 10.0), 12)
    bends = calibration.to_bends(wavelengths(KAPPA) - wavelengths(0.0 * KAPPA))
    np.testing.assert_allclose(bends.real, KAPPA[[0, 2, 3], 0], atol=2e-6)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"# channels": 2}, '"Calibration Matrices" = 65.0: '),
        ({"# channels": "3"}, '"# channels" = "3": '),
        ({"length": 120.0}, '"Sensor Locations" = 135.0: '),
        ({"weights": {"66.0": 1.0}}, 'weights = "66.0": '),
        ({"weights": {"a": 1.0}}, "'a': "),
        ({"Calibration Matrices": {"65.0": {"1": 2}}}, "must be a list"),
        ({"Calibration Matrices": {"65.0": [[math.nan] * 3] * 2}}, "must be a finite number"),
        ({"Sensor Locations": {"1": 65.0}}, "must have at least 2 entries"),
        ({"Central Core CH": 4}, '"Central Core CH" = 4: '),
    ],
    ids=str,
)
def test_a_wrong_file_is_refused_by_key_value_and_rule(file, changes, line):
    path = file(**changes)
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    assert line in str(caught.value)
    assert all(one.startswith(f"{path}: ") and one.isprintable() for one in str(caught.value).splitlines())


def test_what_is_no_json_is_refused(tmp_path):
    path = tmp_path / "needle.json"
    for content in ("{", "[]", "[" * 100_000):
        path.write_text(content)
        with pytest.raises(InputError, match=str(path)):
            read_calibration(path)
    with pytest.raises(InputError, match="No such file"):
        read_calibration(tmp_path / "none.json")


# The sensor


STRAIGHT = wavelengths(0.0 * KAPPA) + 0.05


class Source:
    """An interrogator of a user: a sample in each read, at first of the straight needle."""

    def __init__(self, clock):
        self.clock, self.status, self.closed, self.values = clock, "ok", False, STRAIGHT
        Source.newest = self

    def read(self):
        return [] if self.values is None else [(self.clock.now(), self.values)]

    def close(self):
        self.closed = True


class Noisy(Source):
    """It finds no peak of the last grating, and errs by ± 0.1 pm."""

    def read(self):
        values = STRAIGHT + 1e-4 * (-1) ** round(self.clock.now() / 0.02)
        return [(self.clock.now(), np.append(values[:-1], np.nan) if self.clock.now() < 0.5 else values)]


class Dark(Source):
    def read(self):
        self.status = "lamp off"
        return []


class Short(Source):
    def read(self):
        return [(0.0, STRAIGHT[:5])]


@pytest.fixture
def settings(file, monkeypatch):
    parts = {"halves": lambda _clock: object(), "text": "source"}
    parts |= {each.__name__: each for each in (Source, Noisy, Dark, Short)}
    monkeypatch.setitem(sys.modules, "bench", SimpleNamespace(**parts))
    return {"source": "bench:Source", "calibration": str(file()), "reference_s": 1.0}


@pytest.mark.parametrize("source", ["Source", "Noisy"])
def test_shifts_count_from_the_straight_needle_at_the_start(settings, source):
    clock = ManualClock()
    sensor = make_sensor(settings | {"source": f"bench:{source}"}, clock, SENSOR)
    assert clock.now() == pytest.approx(1.0)
    sample = 2.0, STRAIGHT + wavelengths(KAPPA) - wavelengths(0.0 * KAPPA)
    Source.newest.read = lambda: [sample]
    (reading,) = sensor.read()
    assert reading.time == pytest.approx(1.98)
    np.testing.assert_allclose(reading.rows, KAPPA[::-1], atol=2e-6)
    Source.newest.status = "lamp off"
    assert sensor.status == "lamp off"
    sensor.close()
    assert Source.newest.closed


@pytest.mark.parametrize(
    ("source", "line"),
    [("Dark", "no wavelengths within 1 s: lamp off"), ("Short", "5 wavelengths, expected 12")],
)
def test_without_the_straight_needle_it_is_not_opened(settings, source, line):
    with pytest.raises(DriverError, match=line):
        make_sensor(settings | {"source": f"bench:{source}"}, ManualClock(), SENSOR)
    assert Source.newest.closed


def test_a_lost_grating_leaves_out_its_site_and_a_wrong_number_of_them_all(settings):
    sensor, lost = make_sensor(settings, ManualClock(), SENSOR), STRAIGHT.copy()
    lost[3] = np.nan  # channel 1 at the site next to the tip
    Source.newest.read = lambda: [(2.0, lost), (3.0, STRAIGHT[:5])]
    one, short = sensor.read()
    np.testing.assert_array_equal(np.isnan(one.rows)[:, 0], [True, False, False, False])
    assert (short.rows, short.status[:14]) == ((), "5 wavelengths,")


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"source": "bench:halves"}, 'source = "bench:halves": '),
        ({"source": "bench:text"}, 'source = "bench:text": '),
        ({"source": "hyperion"}, 'source = "hyperion": '),
        ({"turn": 3.0}, "turn = 3.0: "),
    ],
)
def test_wrong_settings_are_refused(settings, changes, line):
    with pytest.raises(RigError) as caught:
        make_sensor(settings | changes, ManualClock(), SENSOR)
    assert str(caught.value).startswith(line)


def test_sites_must_be_between_the_gratings_and_the_kind_must_be_fbg(settings):
    with pytest.raises(RigError, match=r"sites_mm = 5.0: "):
        make_sensor(settings, ManualClock(), Fbg(kind="fbg", sites_mm=(5.0, 50.0)))
    with pytest.raises(RigError, match="slice of the scenario"):
        make_sensor(settings, ManualClock(), Slice(kind="slice", plane_mm=30.0))
