"""The true needle, in two formulations: the geometrically exact rod, and the controller's type of model."""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from flexneedle.errors import InputError
from flexneedle.mechanics.law import tables
from flexneedle.phantom import rod as rd
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.drift import ModulusDrift, scale_moduli
from flexneedle.phantom.equilibrium import step
from flexneedle.phantom.tearing import channel_laws, tear
from flexneedle.plugins import find_part, function_rule, missing_parts, parts_of
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.control import drive_along_entry
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL, Floats, X, Z

_POISSON = 0.3  # steel and nitinol; GJ = EI/(1 + ν) for a round needle
_GUIDE_STIFFNESS = 1e3  # N/mm; the force of a needle on its guide is about 1 N


class Plant(Protocol):
    """A needle that moves on command: the columns of `Control`.

    It may have `nodes`, x, y, z from base to tip (N + 1, 3) in mm; then its shape is recorded.
    """

    def step(self, row: Floats) -> None:
        """Move the needle and cut the tissue."""
        ...

    @property
    def tip(self) -> Floats:
        """Pose x, y, z, θ, ψ (mm, rad) of the end of the needle's axis."""
        ...

    @property
    def roll(self) -> float:
        """Roll of the bevel (rad); 0 bends the path towards +y, π/2 towards +z."""
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

    Without initial bend, friction, and variation of stiffness along the depth; with the model's guide clearance.
    """

    def __init__(self, truth: Truth, roll: float) -> None:
        leaves_plane = any((truth.base_z, truth.base_psi, truth.load[1]))
        space = truth.scenario.with_values({"setup.axes": 2}) if leaves_plane else truth.scenario
        self._simulator, self._drift = Simulator(space, threads=1), ModulusDrift(truth)
        if truth.yield_mm is not None:
            torn = tear(self._simulator.model, space.tissue, truth.yield_mm)
            self._simulator = self._simulator.with_model(torn)
        self._model = self._simulator.model
        start = self._simulator.start(roll)
        _, y, z, theta, psi = start.base.tolist()
        moved = start.with_estimate(
            base=(y + truth.base_y, z + truth.base_z),
            slope=(theta + truth.base_turn, psi + truth.base_psi),
            tip_load=truth.load,
        )
        self._state = self._simulator.step(moved, STILL)
        self._converged = self._state.converged

    def step(self, row: Floats) -> None:
        """Move the needle and cut the tissue."""
        self._state, _ = self._simulator.replay(self._state, row[None])
        self._converged &= self._state.converged
        if self._drift.advance(float(self.tip[X])):
            self._simulator = self._simulator.with_model(scale_moduli(self._model, self._drift.factor))

    @property
    def tip(self) -> Floats:
        """Pose x, y, z, θ, ψ (mm, rad) of the end of the needle's axis."""
        return self._state.tip

    @property
    def roll(self) -> float:
        """Roll of the bevel (rad); 0 bends the path towards +y, π/2 towards +z."""
        return self._state.roll

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

    @property
    def nodes(self) -> Floats:
        """Nodes of the needle from base to tip, x, y and z, shape (N + 1, 3)."""
        return self._state.nodes[:, : Z + 1]


class ExactPlant:
    """The geometrically exact rod (`phantom.rod`), with all imperfections of `[phantom]`."""

    def __init__(self, truth: Truth, roll: float) -> None:
        self.scenario = scenario = truth.scenario
        segments = max(8, round(scenario.needle.length_mm / scenario.phantom.element_mm))
        self.rod = build_rod(truth, segments)
        place, home = scenario.entry.lateral(scenario.start_base_x), scenario.guide_home
        tilt = _tilt(scenario.entry.slope)
        self.state, self.segments = rd.start(
            (scenario.start_base_x, place.real + truth.base_y, place.imag + truth.base_z),
            (tilt.real + truth.base_turn, tilt.imag + truth.base_psi),
            scenario.needle.length_mm,
            segments,
            roll,
        )
        self.state["guide"] = home.real, home.imag
        self.state["load"][1:] = truth.load
        # The path of a needle is longer than its depth, by less than a factor of 2 for insertions along x.
        points = math.ceil(2.0 * max(scenario.setup.max_depth, 1.0) / self.rod.spacing) + 8
        self.channel = np.zeros(points, rd.POINT)
        self.count = 0
        self._drift = ModulusDrift(truth)
        self._converged = True
        self.step(np.array(STILL))

    def step(self, row: Floats) -> None:
        """Move the needle and cut the tissue."""
        driven = drive_along_entry(self.scenario, row)
        self.count = step(self.rod, self.state, self.segments, self.channel, self.count, driven)
        self._converged &= bool(self.state["converged"] > 0.0)
        before = self._drift.factor
        if self._drift.advance(float(self.state["tip"][X])):
            change = self._drift.factor / before
            self.rod.foundation[:] *= change
            self.channel["stiffness"][: self.count] *= change

    @property
    def tip(self) -> Floats:
        """Pose x, y, z, θ, ψ (mm, rad) of the end of the needle's axis: its tilt from x by √(θ² + ψ²)."""
        return np.array([*self.state["tip"], *rd.tip_angles(self.state)[:2]])

    @property
    def roll(self) -> float:
        """Roll of the bevel (rad) before its tilt, from −π to π: the base's roll less the twist of the shaft."""
        return rd.tip_angles(self.state)[2]

    @property
    def strain_energy(self) -> float:
        """Strain energy of the tissue, weighted by layer (mJ)."""
        return float(self.state["strain_energy"])

    @property
    def least_stretch(self) -> float:
        """Smallest present stretch λ of the tissue; 1 is unloaded."""
        return float(self.state["least_stretch"])

    @property
    def converged(self) -> bool:
        """Whether all steps converged to an equilibrium."""
        return self._converged

    @property
    def nodes(self) -> Floats:
        """Nodes of the needle from base to tip, x, y and z, shape (N + 1, 3)."""
        nodes: Floats = self.segments["node"].copy()
        return nodes


def _tilt(slope: complex) -> complex:
    """Return the angle (rad) of a slope, in its direction."""
    size = abs(slope)
    return slope * (math.atan(size) / size) if size > 0.0 else 0.0


def build_rod(truth: Truth, segments: int) -> rd.Rod:
    """Return the constants of the true needle with this number of segments, and of the true tissue in cells."""
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
    torn, torn_place = channel_laws(scenario.tissue, truth.yield_mm)
    modulus, height, width, weight = (
        np.array([getattr(layer, name) for layer in scenario.tissue])[which]
        for name in ("modulus", "compression_length_mm", "engaged_width_mm", "energy_weight")
    )
    guide = scenario.setup.guide_x
    return rd.Rod(
        stiffness=needle.bending_stiffness,
        torsion=needle.bending_stiffness / (1.0 + _POISSON),
        segment=needle.length_mm / segments,
        curvature=2.0 * truth.bend * math.cos(truth.bend_angle) / needle.length_mm**2,
        curvature_across=2.0 * truth.bend * math.sin(truth.bend_angle) / needle.length_mm**2,
        bevel_offset=needle.bevel.offset_mm,
        bevel_length=needle.bevel.length_mm,
        guide_x=math.nan if guide is None else guide,
        clearance=settings.guide_clearance_mm,
        guide_stiffness=_GUIDE_STIFFNESS,
        friction=settings.friction,
        rotation_friction=_rotation_friction(scenario),
        spacing=settings.contact_spacing_mm,
        cell=cell,
        laws=tables([*laws, *torn]),
        law=np.array(place)[which],
        channel_law=len(laws) + np.array(torn_place)[which],
        height=height,
        foundation=modulus * factor * width / height,
        weight=weight,
    )


def _rotation_friction(scenario: Scenario) -> float:
    """Return the largest couple (N·mm per mm) against rotation.

    It is the given one, or the axial friction at the needle's surface.
    """
    settings = scenario.phantom
    if settings.rotation_friction_mn is not None:
        return 1e-3 * settings.rotation_friction_mn
    return settings.friction * 0.5 * scenario.needle.outer_diameter if scenario.setup.axes == 2 else 0.0


PlantFactory = Callable[[Truth, float], Plant]
"""Makes a plant in its start state, from the true phantom and the roll of the needle (rad)."""

PLANTS: dict[str, PlantFactory] = {"exact": ExactPlant, "model": ModelPlant}
DEFAULT_PLANT = "exact"


def find_plant(given: str | PlantFactory) -> tuple[str, PlantFactory]:
    """Return the name of a plant in records, and its factory.

    Args:
        given: A name in `PLANTS`, `module:NAME`, or a factory.

    Raises:
        InputError: There is no such plant.
    """
    return find_part("phantom", given, PLANTS, lambda found: function_rule(found, "truth", "roll"))


def make_plant(kind: str | PlantFactory, truth: Truth, roll: float) -> Plant:
    """Return the plant of a name or a factory in its start state.

    Args:
        kind: As for `find_plant`.
        truth: The true phantom.
        roll: The roll of the needle (rad).

    Raises:
        InputError: The name is unknown, or the factory returns no plant.
    """
    name, factory = find_plant(kind)
    made = factory(truth, roll)
    if missing := missing_parts(made, parts_of(Plant)):
        raise InputError(f"phantom = {name}: {type(made).__name__} is not a plant, missing: {missing}")
    if np.shape(made.tip) != (5,):
        raise InputError(f"phantom = {name}: tip must be five numbers x, y, z (mm), θ, ψ (rad)")
    return made
