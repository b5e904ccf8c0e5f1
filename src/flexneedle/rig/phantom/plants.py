"""The true needle, in two formulations: the geometrically exact rod, and the controller's type of model."""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from flexneedle.errors import InputError
from flexneedle.mechanics.law import tables
from flexneedle.rig.phantom import rod as rd
from flexneedle.rig.phantom.draw import Truth
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Floats

_GUIDE_STIFFNESS = 1e3  # N/mm; the force of a needle on its guide is about 1 N


class Plant(Protocol):
    """A needle that moves on command (db_x, db_y, db_theta, dg_y, flip)."""

    def step(self, row: Floats) -> None:
        """Move the needle and cut the tissue."""
        ...

    @property
    def tip(self) -> Floats:
        """Pose x, y, θ (mm, rad) of the end of the needle's axis."""
        ...

    @property
    def bevel(self) -> int:
        """Direction of the bevel, −1 or +1."""
        ...

    @property
    def strain_energy(self) -> float:
        """Strain energy of the tissue, weighted by layer (mJ)."""
        ...

    @property
    def least_stretch(self) -> float:
        """Smallest present stretch λ of the tissue; 1 is unloaded."""
        ...

    @property
    def converged(self) -> bool:
        """Whether all steps converged to an equilibrium."""
        ...


class ModelPlant:
    """The controller's type of model with the true parameters and a finer mesh.

    Without initial bend, guide clearance, friction, and variation of stiffness along the depth.
    """

    def __init__(self, truth: Truth, bevel: int) -> None:
        self._simulator = Simulator(truth.scenario, threads=1)
        start = self._simulator.start(bevel).with_estimate(base_y=truth.base_y, base_turn=truth.base_turn)
        self._state = self._simulator.step(start, Control())
        self._converged = self._state.converged

    def step(self, row: Floats) -> None:
        """Move the needle and cut the tissue."""
        self._state = self._simulator.step(self._state, Control.from_row(row.tolist()))
        self._converged &= self._state.converged

    @property
    def tip(self) -> Floats:
        """Pose x, y, θ (mm, rad) of the end of the needle's axis."""
        return self._state.tip

    @property
    def bevel(self) -> int:
        """Direction of the bevel, −1 or +1."""
        return self._state.bevel

    @property
    def strain_energy(self) -> float:
        """Strain energy of the tissue, weighted by layer (mJ)."""
        return self._state.strain_energy

    @property
    def least_stretch(self) -> float:
        """Smallest present stretch λ of the tissue; 1 is unloaded."""
        contacts = self._state.contacts
        return float(contacts.stretch[contacts.active].min(initial=1.0))

    @property
    def converged(self) -> bool:
        """Whether all steps converged to an equilibrium."""
        return self._converged


class ExactPlant:
    """The geometrically exact rod (`phantom.rod`), with all imperfections of `[phantom]`."""

    def __init__(self, truth: Truth, bevel: int) -> None:
        scenario = truth.scenario
        segments = max(8, round(scenario.needle.length_mm / scenario.phantom.element_mm))
        self.rod = build_rod(truth, segments)
        self._theta = np.full(segments, truth.base_turn)
        self._work = np.zeros((rd.WORK_ROWS, segments + 1))
        # The path of a needle is longer than its depth, by less than a factor of 2 for insertions along x.
        points = math.ceil(2.0 * max(scenario.setup.max_depth, 1.0) / self.rod.spacing) + 8
        self._channel = np.zeros((rd.CHANNEL_ROWS, points))
        self._count = 0
        self._s = np.zeros(rd.SIZE)
        self._s[[rd.BASE_X, rd.BASE_Y, rd.BASE_TURN]] = (
            scenario.start_base_x,
            truth.base_y,
            truth.base_turn,
        )
        self._s[rd.BEVEL] = bevel
        self._s[[rd.TIP_X, rd.CONVERGED]] = scenario.setup.start_tip_x, 1.0
        self._converged = True
        self.step(np.array([0.0, 0.0, 0.0, 0.0, -1.0]))

    def step(self, row: Floats) -> None:
        """Move the needle and cut the tissue."""
        self._count = rd.step(self.rod, self._s, self._theta, self._channel, self._count, self._work, row)
        self._converged &= bool(self._s[rd.CONVERGED] > 0.0)

    @property
    def tip(self) -> Floats:
        """Pose x, y, θ (mm, rad) of the end of the needle's axis."""
        tip: Floats = self._s[[rd.TIP_X, rd.TIP_Y, rd.TIP_TURN]]
        return tip

    @property
    def bevel(self) -> int:
        """Direction of the bevel, −1 or +1."""
        return int(self._s[rd.BEVEL])

    @property
    def strain_energy(self) -> float:
        """Strain energy of the tissue, weighted by layer (mJ)."""
        return float(self._s[rd.STRAIN_ENERGY])

    @property
    def least_stretch(self) -> float:
        """Smallest present stretch λ of the tissue; 1 is unloaded."""
        return float(self._s[rd.LEAST_STRETCH])

    @property
    def converged(self) -> bool:
        """Whether all steps converged to an equilibrium."""
        return self._converged

    @property
    def nodes(self) -> Floats:
        """Nodes of the needle from base to tip, x and y, shape (N + 1, 2)."""
        return self._work[[rd.X, rd.Y]].T.copy()


def build_rod(truth: Truth, segments: int) -> rd.Rod:
    """The constants of the true needle with this number of segments, and of the true tissue in cells."""
    scenario, settings = truth.scenario, truth.scenario.phantom
    needle, cell = scenario.needle, truth.cell_mm
    cells = math.ceil(max(scenario.setup.max_depth, 0.0) / cell) + 8
    factor = np.ones(cells)
    known = min(cells, len(truth.variation))
    factor[:known] = truth.variation[:known]
    factor[known:] = truth.variation[-1]
    middle = (np.arange(cells) + 0.5) * cell
    which = np.searchsorted(np.array(scenario.layer_tops[1:]), middle, side="right")
    laws, place = laws_of(scenario.tissue)
    modulus, height, width, weight = (
        np.array([getattr(layer, name) for layer in scenario.tissue])[which]
        for name in ("modulus", "compression_length_mm", "engaged_width_mm", "energy_weight")
    )
    guide = scenario.setup.guide_x
    return rd.Rod(
        stiffness=needle.bending_stiffness,
        segment=needle.length_mm / segments,
        curvature=2.0 * truth.bend / needle.length_mm**2,
        bevel_offset=needle.bevel.offset_mm,
        bevel_length=needle.bevel.length_mm,
        guide_x=math.nan if guide is None else guide,
        clearance=settings.guide_clearance_mm,
        guide_stiffness=_GUIDE_STIFFNESS,
        friction=settings.friction,
        spacing=settings.contact_spacing_mm,
        cell=cell,
        laws=tables(laws),
        law=np.array(place)[which],
        height=height,
        foundation=modulus * factor * width / height,
        weight=weight,
    )


PlantFactory = Callable[[Truth, int], Plant]
"""Makes a plant in its start state, from the true phantom and the direction of the bevel, −1 or +1."""

PLANTS: dict[str, PlantFactory] = {"exact": ExactPlant, "model": ModelPlant}
DEFAULT_PLANT = "exact"
_PARTS = ("step", "tip", "bevel", "strain_energy", "least_stretch", "converged")


def plant(kind: str | PlantFactory, truth: Truth, bevel: int) -> Plant:
    """Return the plant of a name or a factory in its start state.

    Raises InputError for an unknown name, or if the factory returns no plant.
    """
    if not isinstance(kind, str):
        return _made(kind, truth, bevel)
    if kind not in PLANTS:
        raise InputError(f"phantom = {kind!r}: must be one of {', '.join(PLANTS)}")
    return PLANTS[kind](truth, bevel)


def _made(factory: PlantFactory, truth: Truth, bevel: int) -> Plant:
    made, name = factory(truth, bevel), getattr(factory, "__name__", type(factory).__name__)
    if missing := [part for part in _PARTS if not hasattr(made, part)]:
        raise InputError(
            f"phantom = {name}: {type(made).__name__} is not a plant, missing: {', '.join(missing)}"
        )
    if np.shape(made.tip) != (3,):
        raise InputError(f"phantom = {name}: tip must be three numbers x, y (mm), slope (rad)")
    return made
