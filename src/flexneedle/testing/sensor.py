"""Conformance kit of the kinds of sensors along the needle."""

import numpy as np

from flexneedle.loop.insertions import insert
from flexneedle.loop.virtual import VirtualRig
from flexneedle.planning.planner import plan
from flexneedle.results import Insertion, Outcome
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sensors.kinds import broken_rule
from flexneedle.scenario.sensors.sensor import Sensor, turn
from flexneedle.testing.checks import require, require_finite, short_scenario
from flexneedle.types import PSI, THETA, Floats, Needles, Reading, VerdictKind, X, Y, Z

_NODES = 61
_STEPS = 400  # from one needle to another
_KINK = 0.25  # largest change of a difference between neighbours, over the largest difference
_ROUNDING = 1e-9
_REJECTED = 0.05


class SensorConformance:
    """Checks of a kind of sensors along the needle. `make` returns a sensor of the kind.

    Attributes:
        scenario: Scenario of needles and insertion (default: the shipped phantom with a target at 10 mm, in the plane).
        axes: Lateral axes with which the sensor is checked.
        depths: Depths (mm) of the tips of the needles with which it is checked.
    """

    scenario: Scenario | None = None
    axes: tuple[int, ...] = (1, 2)
    depths: tuple[float, ...] = (-4.0, 5.0, 10.0)

    def make(self) -> Sensor:
        """Return the sensor."""
        raise NotImplementedError("make: define it in your class, and return your sensor")

    @property
    def _scenario(self) -> Scenario:
        return self.scenario or short_scenario()

    def _needles(self, axes: int, bends: Floats, depths: Floats, turned: float = 0.0) -> Needles:
        """Return needles (m,) with curvatures `bends` (1/mm) and tips at depths (mm), turned (rad) about x."""
        length = self._scenario.needle.length_mm
        along = np.linspace(0.0, length, _NODES)
        poses = np.zeros((len(bends), _NODES, 5))
        poses[..., X] = along - length + depths[:, None]
        way = np.exp(1j * (turned + 0.6 * (axes > 1)))
        for place, slope, share in ((Y, THETA, way.real), (Z, PSI, way.imag)):
            poses[..., place] = share * (0.3 + 0.5 * bends[:, None] * along**2)
            poses[..., slope] = share * bends[:, None] * along
        return Needles(poses, float(along[1]))

    def _some(self, axes: int, turned: float = 0.0) -> Needles:
        depths = np.repeat(self.depths, 2)
        return self._needles(axes, np.tile([0.0, 1e-3], len(self.depths)), depths, turned)

    def test_is_a_sensor(self) -> None:
        """Require a `Sensor` with noise above 0, and values and errors of the model of the right shapes."""
        sensor, scenario = self.make(), self._scenario
        require(isinstance(sensor, Sensor), f"make must return a Sensor, not {type(sensor).__name__}")
        for axes in self.axes:
            rule = broken_rule(sensor, axes, scenario.needle.length_mm, scenario.target.depth_mm)
            require(not rule, f"axes = {axes}: {rule}")

    def test_values_follow_from_the_needles(self) -> None:
        """Require equal values for each needle alone and among others, in each call, and needles unchanged."""
        sensor = self.make()
        for axes in self.axes:
            needles = self._some(axes)
            before = needles.poses.copy()
            values = np.array(sensor.predict(needles, axes))
            again = [sensor.predict(Needles(pose[None], needles.spacing), axes)[0] for pose in needles.poses]
            same = np.allclose(values, again, rtol=_ROUNDING, atol=_ROUNDING * sensor.noise)
            require(same, "predict must return the same values for a needle alone and among others")
            require(np.array_equal(before, needles.poses), "predict must not change the needles")

    def test_values_are_smooth(self) -> None:
        """Require values without steps and kinks where they are measured, while the needle bends or advances."""
        sensor, part = self.make(), np.linspace(0.0, 1.0, _STEPS + 1)
        first, last = min(self.depths), max(self.depths)
        for axes in self.axes:
            for bends, depths, what in (
                (1e-3 * part, np.full_like(part, last), "bends"),
                (np.full_like(part, 1e-3), first + (last - first) * part, "advances"),
            ):
                needles = self._needles(axes, bends, depths)
                seen = np.asarray(sensor.sees(needles, axes))
                steps = np.diff(sensor.predict(needles, axes), axis=0)
                both = seen[:-2] & seen[1:-1] & seen[2:]
                kink = np.where(both, np.abs(np.diff(steps, axis=0)), 0.0).max(axis=0)
                smooth = kink <= _KINK * np.abs(steps).max(axis=0) + _ROUNDING * sensor.noise
                require(
                    smooth.all(),
                    f"axes = {axes}: values must change smoothly while the needle {what}, without steps and kinks: "
                    "numbers of values that do not: " + ", ".join(map(str, np.flatnonzero(~smooth))),
                )

    def test_sees_is_a_flag_for_each_value(self) -> None:
        """Require flags (m, d) of what it can measure, and derivatives to its places (m, d, p)."""
        sensor = self.make()
        for axes in self.axes:
            needles = self._some(axes)
            shape = len(needles.poses), sensor.size(axes)
            seen = np.asarray(sensor.sees(needles, axes))
            rule = f"`sees` must return flags {shape}, not {seen.dtype} {seen.shape}"
            require(seen.shape == shape and seen.dtype == bool, rule)
            slopes, wanted = np.asarray(sensor.slopes(needles, axes)), (*shape, len(sensor.place_sds))
            require(slopes.shape == wanted, f"slopes must return an array {wanted}, not {slopes.shape}")
            require_finite("slopes", slopes)

    def test_read_inverts_report(self) -> None:
        """Require the values of a reading from the rows that `report` gives, NaN where nothing is measured."""
        sensor = self.make()
        for axes in self.axes:
            needles = self._some(axes)
            for pose, values, seen in zip(
                needles.poses, sensor.predict(needles, axes), sensor.sees(needles, axes), strict=True
            ):
                given = np.where(seen, values, np.nan)
                reading = Reading(0.0, sensor.report(given, axes))
                found = np.asarray(sensor.read(reading, Needles(pose[None], needles.spacing), axes))
                same = found.shape == given.shape and np.allclose(
                    found, given, rtol=1e-6, atol=1e-6 * sensor.noise, equal_nan=True
                )
                require(same, f"read must return the values of report: {given} came back as {found}")
            empty = sensor.read(Reading(0.0, ()), Needles(needles.poses[:1], needles.spacing), axes)
            require(np.isnan(empty).all(), f"read must return NaN for a reading without rows, not {empty}")

    def test_rolls_with_the_needle(self) -> None:
        """Require of a sensor that rolls that its values turn with the shape of the needle, in space."""
        sensor = self.make()
        if not sensor.rolls or 2 not in self.axes:
            return
        turned = turn(np.asarray(sensor.predict(self._some(2), 2)), np.exp(0.7j), 2)
        same = np.allclose(sensor.predict(self._some(2, 0.7), 2), turned, rtol=1e-3, atol=1e-3 * sensor.noise)
        require(same, "values of a sensor that rolls must turn with the needle, as lateral vectors")

    def test_same_seed_same_virtual_sensor(self) -> None:
        """Require equal errors of the virtual sensor for equal randomness."""
        for axes in self.axes:
            first, second = (self._draw(axes, np.random.default_rng(3)) for _ in range(2))
            require(np.array_equal(first, second), "the same randomness must give the same virtual sensor")
            require_finite("drawn errors", first)

    def _draw(self, axes: int, rng: np.random.Generator) -> Floats:
        """Return values of the mounted sensor, offsets and drifts, one after the other."""
        sensor = self.make()
        values = sensor.mounted(rng).predict(self._some(axes), axes).ravel()
        return np.concatenate([values, sensor.drawn_offset(rng, axes), sensor.drawn_drift(rng, axes)])

    def test_corrects_an_insertion(self) -> None:
        """Require an insertion in which its readings agree with the model, and the sensor is not excluded."""
        insertion, name = self._insertion(), self.make().title
        ended = f"the insertion ended {insertion.outcome}: {insertion.reason}"
        require(insertion.outcome is Outcome.DONE, ended)
        states = [state for period in insertion.periods for state in period.sensors if state.name == name]
        require(states, f"no sensor {name} in the record")
        excluded = [str(state.verdict) for state in states if not state.verdict.ok]
        require(not excluded, f"the sensor was excluded: {excluded[-1] if excluded else ''}")
        every = [one.verdict for state in states for one in state.readings]
        verdicts = [verdict for verdict in every if verdict.kind is not VerdictKind.MISSING]
        hint = "check `sees`, `report` and `read`, or set `scenario` to a deeper insertion"
        require(verdicts, f"the sensor measured nothing in the insertion: {hint}")
        bad = [str(verdict) for verdict in verdicts if not verdict.ok]
        rejected = f"{len(bad)} of {len(verdicts)} readings were rejected: {bad[-1] if bad else ''}"
        require(len(bad) <= _REJECTED * len(verdicts), rejected)

    def _insertion(self) -> Insertion:
        scenario = self._scenario.with_values({"sensor": [self.make()]})
        planned = plan(scenario, seed=0)
        return insert(scenario, planned, 0, rig=VirtualRig("model"), force=True, threads=1)
