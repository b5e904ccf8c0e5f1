"""The state (X, C) of an insertion: a frozen value that can be compared, pickled, saved and loaded."""

import json
from collections.abc import Iterator
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
from flexneedle.mechanics import insertion
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics.model import CONTACT, ESSENTIAL, Model
from flexneedle.mechanics.needle import Laterals
from flexneedle.mechanics.shape import beam_energy, equal_arc_nodes
from flexneedle.scenario.model import Scenario
from flexneedle.types import Floats

_MECHANICS = ("needle.", "setup.", "tissue", "contact.")  # the keys that a state depends on
_Array = TypeVar("_Array", bound=NDArray[Any])
_Record = TypeVar("_Record", bound=tuple[Any, ...])
_ACROSS = ("y", "slope", "shear", "moment", "force")
_ENERGIES = ("energy", "weighted")


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

    needle, `rest` (k,) and `compression` (k,) are the input of the next step. clamp: part of the base pose that no
    command moved. `mesh` (j,) is the solution at the nodes behind the tip, measured points included: x; y, slope,
    shear, moment and force on the needle; stored energy, the same times w_c. spring_energy: of the tip spring.
    """

    scenario: Scenario
    model: Model
    needle: nd.Needle
    clamp: nd.Pose
    rest: Laterals
    compression: Laterals
    mesh: NDArray[Any]
    spring_energy: float

    @property
    def tip(self) -> Floats:
        """Tip pose x, y, θ, shape (3,)."""
        return np.array(self.needle.solution.tip)

    @property
    def base(self) -> Floats:
        """Pose of the base clamp x, y, θ, shape (3,)."""
        return np.array(self.needle.boundary.base)

    @property
    def travel(self) -> Floats:
        """Sum of the commands since the start: base x, y (mm), base θ (rad) and guide (mm), shape (4,)."""
        base, clamp = self.needle.boundary.base, self.clamp
        x = base.x - (self.scenario.start_base_x + clamp.x)
        return np.array([x, base.y - clamp.y, base.slope - clamp.slope, self.guide])

    @property
    def guide(self) -> float:
        """Lateral position of the guide (mm); 0 without a guide."""
        return float(self.needle.boundary.guide.real)

    @property
    def bevel(self) -> int:
        """Bevel direction bvl, −1 or +1; +1 bends the path towards +y."""
        return int(self.needle.boundary.bevel.real)

    @property
    def tip_load(self) -> float:
        """Additional lateral force at the tip (N), estimated by an observer."""
        return float(self.needle.boundary.load.real)

    @property
    def converged(self) -> bool:
        """Whether the last solve reached its tolerance."""
        return self.needle.solution.converged

    @property
    def iterations(self) -> int:
        """Newton iterations of the last solve."""
        return self.needle.solution.iterations

    @property
    def residual(self) -> float:
        """Estimated distance of the last solve from equilibrium (mm)."""
        return self.needle.solution.residual

    @cached_property
    def nodes(self) -> Floats:
        """Needle state X: (n, 3) of x, y, θ at n equal arc lengths from base to tip."""
        nodes = np.empty((self.scenario.needle.nodes, insertion.POSE_SIZE))
        equal_arc_nodes(*self._curve(), nodes)
        return _frozen(nodes[:, [0, 1, 3]])

    @cached_property
    def contacts(self) -> Contacts:
        """The cut channel."""
        nodes = self.model.nodes
        formed = (nodes["kind"] == CONTACT) & (nodes["x"] < self.needle.channel.front)
        active = nodes["x"] < self.needle.solution.tip.x
        compression = np.where(active, self.compression, 0.0)
        columns = (
            nodes["x"],
            self.rest,
            self.rest + compression,
            1.0 - np.abs(compression) / nodes["height"],
            active,
        )
        return Contacts(*(_frozen(column[formed]) for column in columns))

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
        return Reactions(-loads.shear.real, -loads.moment.real, float(guide.sum()), loads.reaction.real)

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
        boundary, clamp = self.needle.boundary, self.clamp
        old = boundary.base
        base = nd.Pose(
            old.x if base_x is None else base_x,
            old.y if base_y is None else base_y,
            old.slope if base_turn is None else base_turn,
        )
        moved = nd.Pose(
            clamp.x + (base.x - old.x), clamp.y + (base.y - old.y), clamp.slope + (base.slope - old.slope)
        )
        load = boundary.load if tip_load is None else tip_load
        needle = self.needle._replace(boundary=boundary._replace(base=base, load=load))
        return replace(self, needle=needle, clamp=moved)

    def save(self, path: str | Path) -> None:
        """Write the state to `path` (NumPy npz); load it with `Simulator.load`."""
        sink = BytesIO()
        np.savez(sink, scenario=np.array(json.dumps(self.scenario.values())), **self._arrays())
        replace_file(Path(path), sink.getvalue())

    def _arrays(self) -> dict[str, Any]:
        return {
            "needle": np.array(_flat(self.needle)),
            "clamp": np.array(self.clamp),
            "rest": self.rest,
            "compression": self.compression,
            "mesh": self.mesh,
            "spring_energy": np.array(self.spring_energy),
        }

    def _curve(self) -> tuple[Floats, Laterals, Laterals]:
        """x, y, slope of base, nodes and tip."""
        ends = self.needle.boundary.base, self.needle.solution.tip
        rows = zip(ends[0], (self.mesh[name] for name in ("x", "y", "slope")), ends[1], strict=True)
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


def load_state(path: str | Path, start: State) -> State:
    """Read a file of `State.save`, for the scenario and model of `start`.

    StateError if it is not one, or of another scenario, with the differing key.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        saved = Scenario.from_record(json.loads(str(arrays.pop("scenario"))), source=str(path))
    except (OSError, ValueError, KeyError, AttributeError, EOFError, BadZipFile) as error:
        raise StateError(f"{path}: not a saved state ({error})") from error
    if (key := mechanics_difference(saved, start.scenario)) is not None:
        mine, theirs = start.scenario.flat().get(key), saved.flat().get(key)
        raise StateError(f"{path}: saved under another scenario: {key} was {theirs}, is {mine}")
    known = {name: (array.dtype, array.ndim) for name, array in start._arrays().items()}
    if {name: (array.dtype, array.ndim) for name, array in arrays.items()} != known:
        raise StateError(f"{path}: saved by another version of flexneedle")
    needle = _filled(start.needle, iter(arrays.pop("needle").tolist()))
    clamp, energy = nd.Pose(*arrays.pop("clamp").tolist()), float(arrays.pop("spring_energy"))
    parts = {name: _frozen(array) for name, array in arrays.items()}
    return replace(start, needle=needle, clamp=clamp, spring_energy=energy, **parts)


def _flat(record: tuple[Any, ...]) -> list[Any]:
    """All numbers of nested records."""
    return [number for part in record for number in (_flat(part) if isinstance(part, tuple) else [part])]


def _filled(like: _Record, numbers: Iterator[Any]) -> _Record:
    """Records as `like`, of these numbers."""
    parts = (
        _filled(part, numbers) if isinstance(part, tuple) else _typed(part, next(numbers)) for part in like
    )
    return type(like)(*parts)


def _typed(like: Any, number: Any) -> Any:
    return type(like)(number) if isinstance(like, complex) else type(like)(number.real)


def solved(start: State, model: Model, needle: nd.Needle, rest: Laterals, u: Laterals, w: nd.Work) -> State:
    """Freeze a solve of `model` into a state of `start`'s scenario. `model` may have more essential nodes than it."""
    count = needle.solution.last.behind
    stored = np.zeros(count)
    spring = insertion.energies(model, needle, u, stored)
    across, nodes = rest.dtype, model.nodes[:count]
    names = [
        ("x", stored.dtype),
        *((name, across) for name in _ACROSS),
        *((name, stored.dtype) for name in _ENERGIES),
    ]
    mesh = np.zeros(count, names)
    for name in _ACROSS:
        mesh[name] = w[name][:count]
    mesh["x"], mesh["energy"], mesh["weighted"] = nodes["x"], stored, nodes["weight"] * stored
    own = np.flatnonzero(model.nodes["kind"] != ESSENTIAL)
    return replace(
        start,
        needle=needle,
        rest=_frozen(rest[own]),
        compression=_frozen(u[own]),
        mesh=_frozen(mesh),
        spring_energy=spring,
    )


def _frozen(array: _Array) -> _Array:
    array.flags.writeable = False
    return array
