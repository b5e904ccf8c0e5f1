"""The kinds of sensors of the package pass the kit, and wrong kinds fail the check of the rule that they break."""

import numpy as np
import pytest

from flexneedle import Sensor, X, Y
from flexneedle.scenario.sensors.kinds import KINDS
from flexneedle.testing import SensorConformance
from kits import checks_of

PROJECTION = ((10.0, 0.0, 0.0, 300.0), (0.0, 10.0, 2.0, 200.0), (0.0, 0.0, 0.0, 1.0))
MADE = {
    "fbg": {"sites_mm": (11.0, 26.0, 70.0)},
    "slice": {"plane_mm": 5.0, "normal": (1.0, 0.2, 0.1)},
    "points": {"to_mm": 10.0},
    "view": {"from_mm": -20.0, "to_mm": 12.0, "projection": PROJECTION},
}


def kit_of(sensor):
    return type("Kit", (SensorConformance,), {"make": lambda _: sensor})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("check", checks_of(SensorConformance))
def test_the_kinds_of_the_package_pass(kind, check):
    getattr(kit_of(KINDS[kind](kind=kind, **MADE[kind]))(), check)()


class Near(Sensor):
    """The lateral position 5 mm below the skin, mm."""

    @property
    def noise(self):
        return 0.1

    def predict(self, needles, axes):
        del axes
        return needles.at(5.0)[:, [Y]]


class Rounds(Near):
    def predict(self, needles, axes):
        return np.round(super().predict(needles, axes), 1)


class Remembers(Near):
    def predict(self, needles, axes):
        found = super().predict(needles, axes)
        return found - found.mean()


class ChangesTheNeedles(Near):
    def predict(self, needles, axes):
        found = super().predict(needles, axes)
        needles.poses[..., Y] += 1.0
        return found


class TurnsItsSign(Near):
    def report(self, values, axes):
        return super().report(-values, axes)


class CountsOneFlag(Near):
    def sees(self, needles, axes):
        del axes
        return needles.poses[:, -1, X] > 5.0


class RollsAsDistances(Near):
    paired, rolls = True, True

    def predict(self, needles, axes):
        return np.abs(needles.at(5.0)[:, Y : Y + axes]) + 1.0


class DrawsFromTheGlobalGenerator(Near):
    def drawn_offset(self, rng, axes):
        del rng
        return np.random.normal(size=axes)  # noqa: NPY002


class SeesNothing(Near):
    def sees(self, needles, axes):
        return np.zeros((len(needles.poses), self.size(axes)), dtype=bool)


WRONG = {
    Rounds: "test_values_are_smooth",
    Remembers: "test_values_follow_from_the_needles",
    ChangesTheNeedles: "test_values_follow_from_the_needles",
    TurnsItsSign: "test_read_inverts_report",
    CountsOneFlag: "test_sees_is_a_flag_for_each_value",
    RollsAsDistances: "test_rolls_with_the_needle",
    DrawsFromTheGlobalGenerator: "test_same_seed_same_virtual_sensor",
    SeesNothing: "test_corrects_an_insertion",
}


def made(kind):
    return kind(kind=f"{__name__}:{kind.__name__}")


def test_the_sensor_of_the_wrong_kinds_is_right():
    for check in checks_of(SensorConformance):
        getattr(kit_of(made(Near))(), check)()


@pytest.mark.parametrize(("kind", "check"), WRONG.items(), ids=[one.__name__ for one in WRONG])
def test_a_fault_is_found(kind, check):
    with pytest.raises(AssertionError):
        getattr(kit_of(made(kind))(), check)()
