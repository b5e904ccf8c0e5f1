"""The state (X, C) of an insertion: a frozen value that can be compared, pickled, saved and loaded."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from flexneedle.errors import StateError
from flexneedle.files import replace_file
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.model import CONTACT, Model, Nodes
from flexneedle.mechanics.shape import beam_energy, equal_arc_nodes
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

_MECHANICS = ("needle.", "setup.", "tissue", "contact.")  # the keys that a state depends on
_Array = TypeVar("_Array", bound=NDArray[Any])
_WORK_ROWS = (nd.Y, nd.TURN, nd.SHEAR, nd.MOMENT, nd.FORCE, nd.ENERGY)
_X, _Y, _TURN, _SHEAR, _MOMENT, _FORCE, _ENERGY, _WEIGHTED = range(8)  # rows of a mesh


class Contacts(NamedTuple):
    """Contact points of the cut channel, each (k,), by depth: x, rest_y, y (mm), stretch λ, whether active.

    A point ahead of a tip that was pulled back is not active: it is undisplaced, y = rest_y and stretch 1.
    """

    x: Floats
    rest_y: Floats
    y: Floats
    stretch: Floats
    active: NDArray[np.bool_]

    def __repr__(self) -> str:
        least = f", least stretch {self.stretch.min():.4f}" if len(self.x) else ""
        return f"<Contacts {len(self.x)} points, {np.count_nonzero(self.active)} active{least}>"


class Reactions(NamedTuple):
    """Reactions on the needle: lateral forces (N) and the clamp's moment (N·mm), 0 where nothing holds it."""

    base_force: float
    base_moment: float
    guide_force: float
    tip_force: float


@dataclass(frozen=True, eq=False)
class State:
    """The insertion at one instant. Arrays are read-only; angles in rad, lengths in mm, energies in mJ.

    `scalars` (STATE_SIZE,), `rest` (k,) and `compression` (k,) are the input of the next step;
    `mesh` (8, j) is the solution at the nodes behind the tip, measured points included: x, y, θ, shear, moment,
    force on the needle, stored energy, the same times w_c.
    """

    scenario: Scenario
    model: Model
    scalars: Floats
    rest: Floats
    compression: Floats
    mesh: Floats

    @property
    def tip(self) -> Floats:
        """Tip pose x, y, θ, shape (3,)."""
        tip: Floats = self.scalars[[nd.TIP_X, nd.TIP_Y, nd.TIP_TURN]]
        return tip

    @property
    def base(self) -> Floats:
        """Pose of the base clamp x, y, θ, shape (3,)."""
        base: Floats = self.scalars[[nd.BASE_X, nd.BASE_Y, nd.BASE_TURN]]
        return base

    @property
    def travel(self) -> Floats:
        """Sum of the commands since the start: base x, y (mm), base θ (rad) and guide (mm), shape (4,)."""
        s = self.scalars
        travel: Floats = s[[nd.BASE_X, nd.BASE_Y, nd.BASE_TURN, nd.GUIDE_Y]]
        travel[:3] -= self.scenario.start_base_x + s[nd.CLAMP_X], s[nd.CLAMP_Y], s[nd.CLAMP_TURN]
        return travel

    @property
    def guide(self) -> float:
        """Lateral position of the guide (mm); 0 without a guide."""
        return float(self.scalars[nd.GUIDE_Y])

    @property
    def bevel(self) -> int:
        """Bevel direction bvl, −1 or +1; +1 bends the path towards +y."""
        return int(self.scalars[nd.BEVEL])

    @property
    def tip_load(self) -> float:
        """Additional lateral force at the tip (N), estimated by an observer."""
        return float(self.scalars[nd.TIP_LOAD])

    @property
    def converged(self) -> bool:
        """Whether the last solve reached its tolerance."""
        return bool(self.scalars[nd.CONVERGED] > 0.0)

    @property
    def iterations(self) -> int:
        """Newton iterations of the last solve."""
        return int(self.scalars[nd.ITERATIONS])

    @property
    def residual(self) -> float:
        """Estimated distance of the last solve from equilibrium (mm)."""
        return float(self.scalars[nd.RESIDUAL])

    @cached_property
    def nodes(self) -> Floats:
        """Needle state X: (n, 3) of x, y, θ at n equal arc lengths from base to tip."""
        return _frozen(equal_arc_nodes(*self._curve(), self.scenario.needle.nodes))

    @cached_property
    def contacts(self) -> Contacts:
        """The cut channel."""
        nodes = self.model.nodes
        formed = (nodes.kind == CONTACT) & (nodes.x < self.scalars[nd.FRONT])
        active = nodes.x < self.scalars[nd.TIP_X]
        compression = np.where(active, self.compression, 0.0)
        columns = (
            nodes.x,
            self.rest,
            self.rest + compression,
            1.0 - np.abs(compression) / nodes.height,
            active,
        )
        return Contacts(*(_frozen(column[formed]) for column in columns))

    @cached_property
    def strain_energy(self) -> float:
        """Tissue strain energy Σ w_c W of the contacts (mJ), weighted by layer (paper eq. 12)."""
        # Summed in order, as the rollout kernel does, so that both agree to the last bit.
        return float(np.cumsum(np.append(0.0, self.mesh[_WEIGHTED]))[-1])

    @cached_property
    def energy(self) -> float:
        """Stored energy of beam, contacts and tip spring (mJ), unweighted."""
        x, _, _ = self._curve()
        shear = np.append(self.scalars[nd.BASE_SHEAR], self.mesh[_SHEAR])
        moment = np.append(self.scalars[nd.BASE_MOMENT], self.mesh[_MOMENT])
        beam = beam_energy(x, shear, moment, self.model.bending_stiffness)
        return float(beam + self.mesh[_ENERGY].sum() + self.scalars[nd.SPRING_ENERGY])

    @property
    def reactions(self) -> Reactions:
        """Forces of clamp, guide and held tip on the needle."""
        s = self.scalars
        guide = self.mesh[_FORCE][self.mesh[_X] == self.scenario.setup.guide_x]
        return Reactions(
            -float(s[nd.BASE_SHEAR]),
            -float(s[nd.BASE_MOMENT]),
            float(guide.sum()),
            float(s[nd.TIP_REACTION]),
        )

    def with_estimate(
        self,
        *,
        base_x: float | None = None,
        base_y: float | None = None,
        base_turn: float | None = None,
        tip_load: float | None = None,
    ) -> "State":
        """Return the state with an observer's corrections (mm, rad, N), which take effect in the next solve.

        A corrected base position does not count as travel.
        """
        scalars = self.scalars.copy()
        if base_x is not None:
            scalars[nd.CLAMP_X] += base_x - scalars[nd.BASE_X]
            scalars[nd.BASE_X] = base_x
        if base_y is not None:
            scalars[nd.CLAMP_Y] += base_y - scalars[nd.BASE_Y]
            scalars[nd.BASE_Y] = base_y
        if base_turn is not None:
            scalars[nd.CLAMP_TURN] += base_turn - scalars[nd.BASE_TURN]
            scalars[nd.BASE_TURN] = base_turn
        if tip_load is not None:
            scalars[nd.TIP_LOAD] = tip_load
        return replace(self, scalars=_frozen(scalars))

    def save(self, path: str | Path) -> None:
        """Write the state to `path` (NumPy npz); load it with `Simulator.load`."""
        sink = BytesIO()
        np.savez(sink, scenario=np.array(json.dumps(self.scenario.values())), **self._arrays())
        replace_file(Path(path), sink.getvalue())

    def _arrays(self) -> dict[str, Any]:
        return {
            "scalars": self.scalars,
            "rest": self.rest,
            "compression": self.compression,
            "mesh": self.mesh,
        }

    def _curve(self) -> tuple[Floats, Floats, Floats]:
        """x, y, θ of base, nodes and tip."""
        rows = zip(self.base, self.mesh[: _TURN + 1], self.tip, strict=True)
        first, second, third = (np.concatenate([[base], inner, [tip]]) for base, inner, tip in rows)
        return first, second, third

    def _bytes(self) -> tuple[bytes, ...]:
        return tuple(array.tobytes() for array in self._arrays().values())

    def __eq__(self, other: object) -> bool:
        """Whether scenario and arrays are the same, to the bit: 0 is not −0, and NaN equals the same NaN."""
        if not isinstance(other, State):
            return NotImplemented
        return self._bytes() == other._bytes() and self.scenario == other.scenario

    def __hash__(self) -> int:
        return hash(self._bytes())

    def __repr__(self) -> str:
        x, y, slope = self.tip
        ended = "converged" if self.converged else "NOT converged"
        where = f"tip ({x:.3f}, {y:.3f}) mm, slope {1e3 * slope:.2f} mrad, guide {self.guide:.3f} mm"
        return f"<State {where}, bevel {self.bevel:+d}, {self.strain_energy:.4g} mJ in the tissue, {ended}>"


def mechanics_difference(one: Scenario, other: Scenario) -> str | None:
    """Return the first key on which the mechanics of two scenarios differ, or None."""
    mine, theirs = one.flat(), other.flat()
    for key in [*mine, *(key for key in theirs if key not in mine)]:
        if key.startswith(_MECHANICS) and mine.get(key) != theirs.get(key):
            return key
    return None


def load_arrays(path: str | Path, scenario: Scenario) -> dict[str, Floats]:
    """Read a file of `State.save`; StateError if it is not one, or of another scenario, with the differing key."""
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        saved = Scenario.from_record(json.loads(str(arrays.pop("scenario"))), source=str(path))
    except (OSError, ValueError, KeyError, AttributeError, EOFError, BadZipFile) as error:
        raise StateError(f"{path}: not a saved state ({error})") from error
    if (key := mechanics_difference(saved, scenario)) is not None:
        mine, theirs = scenario.flat().get(key), saved.flat().get(key)
        raise StateError(f"{path}: saved under another scenario: {key} was {theirs}, is {mine}")
    if set(arrays) != {"scalars", "rest", "compression", "mesh"} or arrays["scalars"].shape != (
        nd.STATE_SIZE,
    ):
        raise StateError(f"{path}: saved by another version of flexneedle")
    return {name: _frozen(array) for name, array in arrays.items()}


def solved(scenario: Scenario, model: Model, s: Floats, rest: Floats, u: Floats, mesh: Floats) -> State:
    """Freeze the work arrays of a solve and its `mesh_of` into a state."""
    return State(scenario, model, _frozen(s), _frozen(rest), _frozen(u), _frozen(mesh))


def mesh_of(nodes: Nodes, w: Floats, count: int) -> Floats:
    """Collect the solution at the `count` nodes behind the tip, (8, count), from the work array of a solve."""
    mesh = np.concatenate([nodes.x[None, :count], w[list(_WORK_ROWS), :count], np.zeros((1, count))])
    tissue = nodes.kind[:count] == CONTACT
    mesh[_ENERGY] = np.where(tissue, mesh[_ENERGY], 0.0)
    mesh[_WEIGHTED] = nodes.weight[:count] * mesh[_ENERGY]
    return mesh


def _frozen(array: _Array) -> _Array:
    array.flags.writeable = False
    return array
