"""The state (X, C) of an insertion: a frozen value that can be compared and pickled."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.lateral import lateral
from flexneedle.mechanics.model import Model
from flexneedle.mechanics.needle import Laterals
from flexneedle.mechanics.rollout import Outputs
from flexneedle.mechanics.shape import beam_energy
from flexneedle.mechanics.work import CONTACT, ESSENTIAL
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.batch import sample_shapes
from flexneedle.types import THETA, Floats, Lateral

_Array = TypeVar("_Array", bound=NDArray[Any])
_ACROSS = ("y", "slope", "shear", "moment", "force")
_ENERGIES = ("energy", "weighted")


class Contacts(NamedTuple):
    """Contact points of the cut channel by depth, (k,).

    A point ahead of a tip that was pulled back is not active: it is undisplaced, position = rest and stretch 1.
    """

    x: Floats  # x (mm)
    rest: Floats  # position y, z at rest (k, 2), mm
    position: Floats  # present position y, z (k, 2), mm
    stretch: Floats  # stretch λ
    active: NDArray[np.bool_]  # whether the point is behind the tip
    law: NDArray[np.int64]  # index of the law along the channel, as in `all_laws`

    def __repr__(self) -> str:
        least = f", least stretch {self.stretch.min():.4f}" if len(self.x) else ""
        return f"<Contacts {len(self.x)} points, {np.count_nonzero(self.active)} active{least}>"


class Reactions(NamedTuple):
    """Reactions on the needle: lateral forces (N) and moments (N·mm), 0 where nothing holds it."""

    base_force: Lateral
    base_moment: Lateral
    guide_force: Lateral
    tip_force: Lateral
    tip_moment: Lateral


@dataclass(frozen=True, eq=False)
class State:
    """The insertion at one instant. Arrays are read-only; angles in rad, lengths in mm, energies in mJ.

    Attributes:
        scenario: Scenario of the simulator.
        model: Constants of the simulator.
        clamp: Part of the base pose that no command moved.
        roll: The needle's angle about its axis, with whole turns; 0 bends the path towards +y, π/2 towards +z.
        solved: The needle after its last solve.
    """

    scenario: Scenario
    model: Model
    clamp: nd.NodePose
    roll: float
    solved: "Solved"

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Take the values of a copy or a pickle, read-only."""
        self.__dict__.update(_frozen(values))

    @cached_property
    def needle(self) -> nd.NeedleState:
        """The needle and the channel."""
        return nd.from_row(self.solved.row)

    @cached_property
    def rest(self) -> Laterals:
        """Rest positions (k,) of the contacts."""
        return _freeze(nd.from_parts(self.solved.rest))

    @cached_property
    def compression(self) -> Laterals:
        """Compressions (k,) of the contacts."""
        return _freeze(nd.from_parts(self.solved.compression))

    @property
    def mesh(self) -> NDArray[Any]:
        """Solution (j,) at the nodes behind the tip."""
        return self.solved.mesh

    @property
    def spring_energy(self) -> float:
        """Energy of the tip spring."""
        return self.solved.spring_energy

    @property
    def tip(self) -> Floats:
        """Tip pose x, y, z, θ, ψ, shape (5,)."""
        return _row(self.needle.solution.tip)

    @property
    def base(self) -> Floats:
        """Pose of the base clamp x, y, z, θ, ψ, shape (5,)."""
        return _row(self.needle.boundary.base)

    @property
    def travel(self) -> Floats:
        """Sum of the commands since the start: base x, y, z (mm), θ, ψ (rad) and guide y, z (mm), shape (7,)."""
        base, clamp = self.needle.boundary.base, self.clamp
        x = base.x - (self.scenario.start_base_x + clamp.x)
        guide = self.needle.boundary.guide - self.scenario.guide_home
        across = base.y - clamp.y - self.scenario.entry.slope * x
        return np.array([*_row(nd.NodePose(x, across, base.slope - clamp.slope)), *_pair(guide)])

    @property
    def guide(self) -> Lateral:
        """Position y, z of the guide (mm); 0 without a guide."""
        return _pair(self.needle.boundary.guide)

    @property
    def bevel(self) -> complex:
        """Direction of the bevel, a unit number y + iz; ±1 in the plane."""
        return complex(self.needle.boundary.bevel)

    @property
    def tip_load(self) -> Lateral:
        """Additional force y, z at the tip (N), estimated by an observer."""
        return _pair(self.needle.boundary.load)

    @property
    def converged(self) -> bool:
        """Whether the last solve reached its tolerance."""
        return self.needle.solution.converged > 0.0

    @property
    def iterations(self) -> int:
        """Newton iterations of the last solve."""
        return int(self.needle.solution.iterations)

    @property
    def residual(self) -> float:
        """Estimated distance of the last solve from equilibrium (mm)."""
        return self.needle.solution.residual

    @cached_property
    def nodes(self) -> Floats:
        """Needle state X: poses (n, 5) at n equal arc lengths from base to tip: x, y, z, θ, ψ."""
        x, y, slope = self._curve()
        across = self.solved.rest.shape[1]
        curve = np.concatenate([x[:, None], nd.to_parts(y, across), nd.to_parts(slope, across)], axis=1)
        return _freeze(sample_shapes(curve, self.scenario.needle.nodes))

    @property
    def body(self) -> Floats:
        """Points (k, 3) of the inserted needle's axis, at the contacts and the tip, mm; none before the skin."""
        x, y, _ = self._curve()
        points: Floats = np.stack([x, y.real, y.imag], axis=1)[1:]
        return points[points[:, 0] > 0.0]

    @cached_property
    def contacts(self) -> Contacts:
        """The cut channel."""
        nodes = self.model.nodes
        formed = (nodes["kind"] == CONTACT) & (nodes["x"] < self.needle.channel.front)
        active = nodes["x"] < self.needle.solution.tip.x
        compression = np.where(active, self.compression, 0.0)
        columns = (
            nodes["x"],
            _pairs(self.rest),
            _pairs(self.rest + compression),
            1.0 - np.abs(compression) / nodes["height"],
            active,
            nodes["law"],
        )
        return Contacts(*(_freeze(column[formed]) for column in columns))

    @property
    def least_stretch(self) -> float:
        """Least stretch λ of the tissue; 1 is unloaded."""
        nodes, needle = self.model.nodes, self.needle
        behind = nodes["x"] < min(needle.channel.front, needle.solution.tip.x)
        pressed = behind & (nodes["kind"] == CONTACT)
        return 1.0 - float((np.abs(self.compression[pressed]) / nodes["height"][pressed]).max(initial=0.0))

    @cached_property
    def strain_energy(self) -> float:
        """Tissue strain energy Σ w_c W of the contacts (mJ), weighted by layer (paper eq. 12)."""
        # Summed in order, as the rollout kernel does, so that both agree to the last bit.
        return float(np.cumsum(np.append(0.0, self.mesh["weighted"]))[-1])

    @cached_property
    def energy(self) -> float:
        """Stored energy of beam, contacts and tip spring (mJ), unweighted."""
        x, _, _ = self._curve()
        loads = self.needle.solution.loads
        shear = np.append(loads.shear, self.mesh["shear"])
        moment = np.append(loads.moment, self.mesh["moment"])
        beam = beam_energy(x, shear, moment, self.model.bending_stiffness)
        return float(beam + self.mesh["energy"].sum() + self.spring_energy)

    @property
    def reactions(self) -> Reactions:
        """Forces of clamp, guide and held tip on the needle."""
        loads = self.needle.solution.loads
        guide = self.mesh["force"][self.mesh["x"] == self.scenario.setup.guide_x]
        forces = -loads.shear, -loads.moment, complex(guide.sum()), loads.reaction, loads.couple
        return Reactions(*map(_pair, forces))

    def with_estimate(
        self,
        *,
        base_x: float | None = None,
        base: Sequence[float] | None = None,
        slope: Sequence[float] | None = None,
        tip_load: Sequence[float] | None = None,
    ) -> "State":
        """Return the state with an observer's corrections (mm, rad, N), which take effect in the next solve.

        base, slope, tip_load: y and, in space, z. A corrected base position does not count as travel.
        """
        boundary, clamp = self.needle.boundary, self.clamp
        old = boundary.base

        def across(now: complex, given: Sequence[float] | None) -> complex:
            return now if given is None else lateral(now, *_with_z(given))

        pose = nd.NodePose(old.x if base_x is None else base_x, across(old.y, base), across(old.slope, slope))
        moved = nd.NodePose(
            clamp.x + (pose.x - old.x), clamp.y + (pose.y - old.y), clamp.slope + (pose.slope - old.slope)
        )
        load = across(boundary.load, tip_load)
        needle = self.needle._replace(boundary=boundary._replace(base=pose, load=load))
        return State(self.scenario, self.model, moved, self.roll, self.solved.with_needle(needle))

    def discount_advance(self, extra: float) -> "State":
        """Return the state with this part (mm) of the base's advance counted as an error, which is no travel."""
        clamp, offset = self.clamp, self.scenario.entry.slope * extra
        across = lateral(clamp.y, clamp.y.real + offset.real, clamp.y.imag + offset.imag)
        moved = nd.NodePose(clamp.x + extra, across, clamp.slope)
        return State(self.scenario, self.model, moved, self.roll, self.solved)

    def _curve(self) -> tuple[Floats, Laterals, Laterals]:
        """Return x, y and slope of base, nodes and tip."""
        ends = self.needle.boundary.base, self.needle.solution.tip
        rows = zip(ends[0], (self.mesh[name] for name in ("x", "y", "slope")), ends[1], strict=True)
        first, second, third = (np.concatenate([[base], inner, [tip]]) for base, inner, tip in rows)
        return first, second, third

    def _bytes(self) -> tuple[bytes, ...]:
        clamp, solved = np.array([*self.clamp, self.roll]), self.solved
        arrays = clamp, solved.row, solved.rest, solved.compression, solved.solution, solved.stored
        return tuple(array.tobytes() for array in arrays)

    def __eq__(self, other: object) -> bool:
        """Return whether scenario and arrays are the same, to the bit: 0 is not −0, and NaN equals the same NaN."""
        if not isinstance(other, State):
            return NotImplemented
        return self._bytes() == other._bytes() and self.scenario == other.scenario

    def __hash__(self) -> int:
        return hash(self._bytes())

    def __repr__(self) -> str:
        count = self.scenario.setup.axes
        position = ", ".join(f"{value:.3f}" for value in self.tip[: 1 + count])
        slope = ", ".join(f"{1e3 * value:.2f}" for value in self.tip[THETA : THETA + count])
        guide = ", ".join(f"{value:.3f}" for value in self.guide[:count])
        where = (
            f"tip ({position}) mm, slope {slope} mrad, guide {guide} mm, roll {math.degrees(self.roll):.0f}°"
        )
        ended = "converged" if self.converged else "NOT converged"
        return f"<State {where}, {self.strain_energy:.4g} mJ in the tissue, {ended}>"


def _with_z(given: Sequence[float]) -> tuple[float, float]:
    """Return y and z, 0 if it is not given."""
    y, z = (*given, 0.0)[:2]
    return y, z


def _pair(value: complex) -> Lateral:
    return float(value.real), float(value.imag)


def _pairs(values: Laterals) -> Floats:
    return np.stack([values.real, values.imag], axis=-1)


def _row(pose: nd.NodePose) -> Floats:
    (y, z), (theta, psi) = _pair(pose.y), _pair(pose.slope)
    return np.array([pose.x, y, z, theta, psi])


@dataclass(frozen=True, eq=False)
class Solved:
    """A needle after a solve, as arrays of numbers of kernels; the first three are the input of the next step.

    row: numbers of the needle (`to_row`). rest, compression (k, axes): of the contacts, mm. x, weight (j,): of the
    nodes behind the tip, including measured points. solution (j, 5, axes): y, slope, shear, moment, and force on the
    needle there. stored (j + 1,): energies of the nodes, and of the tip spring (mJ).
    """

    row: Floats
    rest: Floats
    compression: Floats
    x: Floats
    weight: Floats
    solution: Floats
    stored: Floats

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Take the values of a copy or a pickle, read-only."""
        self.__dict__.update(_frozen(values))

    @staticmethod
    def of(model: Model, out: Outputs, number: int) -> "Solved":
        """Return a needle from the outputs of a rollout of `model`."""
        ends, nodes = out.ends, model.nodes
        row = ends.needles[number]
        behind = int(row[nd.BEHIND])
        stored = np.concatenate([out.stored[number, :behind], out.stored[number, -1:]])
        rest, compression = ends.rest[number, : nodes.size], ends.compression[number, : nodes.size]
        solution = out.solution[number, :behind]
        arrays = row, rest, compression, nodes["x"][:behind], nodes["weight"][:behind], solution, stored
        return Solved(*(_freeze(array.copy()) for array in arrays))

    @staticmethod
    def unsolved(needle: nd.NeedleState, nodes: int, axes: int) -> "Solved":
        """Return a needle before its first solve."""
        none = np.zeros((nodes, axes))
        return Solved(
            nd.to_row(needle, axes), none, none, none[:0, 0], none[:0, 0], np.zeros((0, 5, axes)), np.zeros(1)
        )

    def without_points(self, nodes: NDArray[Any]) -> "Solved":
        """Return the same without contacts at the measured points among `nodes` (k,)."""
        kept = nodes["kind"] != ESSENTIAL
        return replace(self, rest=_freeze(self.rest[kept]), compression=_freeze(self.compression[kept]))

    def with_needle(self, needle: nd.NeedleState) -> "Solved":
        """Return the same with other numbers of the needle, for the next solve."""
        return replace(self, row=_freeze(nd.to_row(needle, self.rest.shape[1])))

    @cached_property
    def mesh(self) -> NDArray[Any]:
        """Solution (j,) at the nodes behind the tip by name: x; y, slope, shear, moment, force; energy, weighted."""
        across = nd.from_parts(self.solution)
        real = self.x.dtype
        mesh = np.zeros(
            self.x.size,
            [("x", real), *((n, across.dtype) for n in _ACROSS), *((n, real) for n in _ENERGIES)],
        )
        mesh["x"], mesh["energy"] = self.x, self.stored[:-1]
        mesh["weighted"] = self.weight * self.stored[:-1]
        for k, name in enumerate(_ACROSS):
            mesh[name] = across[:, k]
        return _freeze(mesh)

    @property
    def spring_energy(self) -> float:
        """Energy of the tip spring (mJ)."""
        return float(self.stored[-1])


def _frozen(values: dict[str, Any]) -> dict[str, Any]:
    return {name: _freeze(v) if isinstance(v, np.ndarray) else v for name, v in values.items()}


def _freeze(array: _Array) -> _Array:
    array.flags.writeable = False
    return array
