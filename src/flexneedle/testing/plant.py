"""Conformance kit of the port `Plant`."""

import copy
import math

import numpy as np

from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import Plant
from flexneedle.plugins import parts_of
from flexneedle.scenario.model import Scenario
from flexneedle.testing.checks import require, require_finite, require_parts, short_scenario
from flexneedle.types import STILL, Control, Floats, X, Y

_MOST_SLIP = 0.5  # mm of the tip along x that 1 mm of the base may lack, or exceed
_TURN = 0.05  # rad
_REST = 2e-3  # mm and rad: of a needle that relaxes against friction


class PlantConformance:
    """Checks of a plant. `make` returns the plant in its start state.

    Attributes:
        scenario: Scenario of the truth (default: the shipped phantom, with the tip 4 mm before the skin).
    """

    scenario: Scenario | None = None

    def make(self, truth: Truth, roll: float) -> Plant:
        """Return the plant of a truth, with the roll of the needle (rad) at the start."""
        raise NotImplementedError("make: define it in your class, and return your part")

    def _truth(self) -> Truth:
        return Truth(self.scenario or short_scenario())

    def _insert_steps(self, roll: float = 0.0, steps: int = 12) -> Plant:
        """Return a plant after steps of 1 mm."""
        plant = self.make(self._truth(), roll)
        for _ in range(steps):
            plant.step(_row(db_x=1.0))
        return plant

    def test_has_the_parts_of_the_port(self) -> None:
        """Require all methods and attributes of `Plant`."""
        require_parts("the plant", self.make(self._truth(), 0.0), *parts_of(Plant))

    def test_tip_is_a_pose(self) -> None:
        """Require a tip of five finite numbers, at the start and in the tissue."""
        for plant in (self.make(self._truth(), 0.0), self._insert_steps()):
            require(np.shape(plant.tip) == (5,), f"tip must have the shape (5,), not {np.shape(plant.tip)}")
            require_finite("tip", plant.tip)

    def test_starts_where_the_scenario_does(self) -> None:
        """Require the tip at `setup.start_tip_x` (mm), and the roll that was given (rad)."""
        truth = self._truth()
        for roll in (0.0, math.pi):
            plant, start = self.make(truth, roll), truth.scenario.setup.start_tip_x
            require(
                abs(plant.tip[X] - start) < _MOST_SLIP, f"tip x must start at {start} mm, not {plant.tip[X]}"
            )
            require(_angle(plant.roll, roll) < _TURN, f"roll must start at {roll} rad, not {plant.roll}")

    def test_base_moves_the_tip_in_millimetres(self) -> None:
        """Require that the tip advances as far as the base, within 0.5 mm in 10 mm."""
        before, after = self._insert_steps(steps=0).tip[X], self._insert_steps(steps=10).tip[X]
        require(
            abs(after - before - 10.0) < _MOST_SLIP, f"10 mm of the base moved the tip by {after - before} mm"
        )

    def test_roll_turns_the_bevel_in_radians(self) -> None:
        """Require that a roll by π turns the bevel to the other side and leaves the depth."""
        plant = self.make(self._truth(), 0.0)
        depth = float(plant.tip[X])
        plant.step(_row(roll=math.pi))
        require(
            _angle(plant.roll, math.pi) < _TURN, f"a roll by π must turn the bevel by π, not {plant.roll} rad"
        )
        require(abs(plant.tip[X] - depth) < 0.1, f"a roll must not move the tip along x, from {depth} mm")

    def test_path_bends_towards_the_bevel(self) -> None:
        """Require that the needle ends further towards +y with roll 0 than with roll π."""
        up, down = (float(self._insert_steps(roll).tip[Y]) for roll in (0.0, math.pi))
        require(up > down, f"roll 0 must bend towards +y: y = {up} mm, with roll π {down} mm")

    def test_still_command_moves_nothing(self) -> None:
        """Require the same tip after a command of zeros."""
        plant = self._insert_steps()
        before = np.array(plant.tip)
        plant.step(np.array(STILL))
        require(
            np.allclose(plant.tip, before, atol=_REST), f"zeros moved the tip from {before} to {plant.tip}"
        )

    def test_reading_changes_nothing(self) -> None:
        """Require equal values from repeated reads."""
        plant = self._insert_steps()
        before, after = _read(plant), _read(plant)
        require(before == after, f"reads must not change the plant: {before}, then {after}")

    def test_command_and_truth_are_not_changed(self) -> None:
        """Require that `step` does not change its row, nor the plant its truth."""
        truth, row = self._truth(), _row(db_x=1.0, roll=math.pi)
        before, given = repr(truth), copy.copy(row)
        plant = self.make(truth, 0.0)
        plant.step(row)
        require((row == given).all(), "step must not change the row that it is given")
        require(repr(truth) == before, "a plant must not change its truth")

    def test_energy_and_stretch_are_physical(self) -> None:
        """Require a finite energy of at least 0 mJ, a stretch above 0, and whether all steps converged."""
        for plant in (self.make(self._truth(), 0.0), self._insert_steps()):
            require_finite("strain_energy", plant.strain_energy)
            require(
                plant.strain_energy >= 0.0, f"strain_energy must be at least 0, not {plant.strain_energy}"
            )
            require(plant.least_stretch > 0.0, f"least_stretch must be above 0, not {plant.least_stretch}")
            require(
                isinstance(plant.converged, bool | np.bool_), f"converged must be a bool: {plant.converged!r}"
            )

    def test_plants_are_independent(self) -> None:
        """Require that equal plants with equal commands are equal, while another plant moves, too."""
        first, second = self.make(self._truth(), 0.0), self.make(self._truth(), 0.0)
        for _ in range(3):
            first.step(_row(db_x=1.0))
        other = _read(second)
        for _ in range(3):
            second.step(_row(db_x=1.0))
        fresh = _read(self.make(self._truth(), 0.0))
        require(other == fresh, "a plant must not be moved by the commands of another")
        require(_read(first) == _read(second), "equal truths and commands must give equal plants")

    def test_nodes_end_at_the_tip(self) -> None:
        """Require `nodes`, where the plant has them, of shape (N + 1, 3) with the tip last."""
        plant = self._insert_steps()
        nodes = getattr(plant, "nodes", None)
        if nodes is None:
            return
        require(
            np.ndim(nodes) == 2 and np.shape(nodes)[1] == 3,
            f"nodes must have the shape (N, 3): {np.shape(nodes)}",
        )
        require_finite("nodes", nodes)
        off = float(np.linalg.norm(np.asarray(nodes)[-1] - np.asarray(plant.tip)[:3]))
        require(off < _MOST_SLIP, f"the last node must be the tip, and is {off} mm away")


def _row(db_x: float = 0.0, roll: float = 0.0) -> Floats:
    row: Floats = np.array(tuple(Control(db_x, roll=roll)))
    return row


def _angle(one: float, other: float) -> float:
    return abs(math.remainder(float(one) - other, 2.0 * math.pi))


def _read(plant: Plant) -> tuple[float, ...]:
    return (*map(float, plant.tip), plant.roll, plant.strain_energy, plant.least_stretch, plant.converged)
