"""Recorded insertions in the needle's frame: a table of steps, `steps.parquet`, and their origin, `session.toml`.

`readings.parquet` has the readings of sensors along the needle, if there are any.
"""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from io import BytesIO
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import tomli_w

from flexneedle.arguments import require_extra
from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.calibration.readings import (
    READINGS_FILE,
    StepReading,
    from_reading_columns,
    to_reading_columns,
)
from flexneedle.types import Flags, Floats

STEPS_FILE, SESSION_FILE = "steps.parquet", "session.toml"
GuideOrder = Literal["before", "with", "after"]
"""Motion of the guide before, with or after the advance from a step to the next."""
_FORMAT = 1
STILL = 0.05
"""Motion (mm or rad) up to which a stage is still."""
_ACROSS = ("y", "z")
_NUMBERS = ("position", "slope", "guide", "base")
_UNITS = {"position": "mm", "slope": "rad", "guide": "mm", "base": "mm"}


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded insertion: k states of the needle at rest, in mm and rad.

    Attributes:
        session: Name of its session: one needle, rig and tissue.
        name: Its name.
        time: Times (k,) in s; NaN where unknown.
        depth: x (k,) of the tip, from the skin into the tissue.
        position: y and, in space, z (k, axes) of the tip.
        slope: dy/dx and dz/dx (k, axes) of the sensor's axis; NaN where unknown.
        guide: y, z (k, axes) of the guide.
        base: y, z (k, axes) of the base.
        roll: Angle (k,) of the needle.
        readings: Readings of sensors along the needle.
    """

    session: str
    name: str
    time: Floats
    depth: Floats
    position: Floats
    slope: Floats
    guide: Floats
    base: Floats
    roll: Floats
    readings: tuple[StepReading, ...] = ()

    @property
    def axes(self) -> int:
        """Lateral axes."""
        return int(self.position.shape[1])

    @cached_property
    def key(self) -> tuple[str, str, str]:
        """Session, name, and a hash of the steps."""
        steps = np.column_stack([self.depth, self.position, self.guide])
        return self.session, self.name, sha256(steps.tobytes()).hexdigest()[:12]

    @property
    def guide_moves(self) -> float:
        """Largest distance (mm) of the guide from its first position."""
        return float(np.linalg.norm(self.guide - self.guide[0], axis=1).max())

    @property
    def rests(self) -> bool:
        """True if guide and base rest."""
        base = np.linalg.norm(self.base - self.base[0], axis=1).max()
        return bool(max(self.guide_moves, base) < STILL)

    @cached_property
    def moved(self) -> Flags:
        """Steps (k,) before which guide, base or roll moved."""
        change = np.column_stack([self.guide, self.base, self.roll])
        return np.append(False, (np.abs(np.diff(change, axis=0)) > STILL).any(axis=1))

    def first(self, count: int) -> "Recording":
        """Return the first steps of the insertion."""
        kept: dict[str, Any] = {
            name: getattr(self, name)[:count] for name in ("time", "depth", "roll", *_NUMBERS)
        }
        return replace(self, **kept, readings=tuple(one for one in self.readings if one.step < count))

    def __repr__(self) -> str:
        return (
            f"<Recording {self.session}/{self.name}, {len(self.depth)} steps to {self.depth[-1]:.1f} mm, "
            f"guide moves {self.guide_moves:.1f} mm>"
        )


@dataclass(frozen=True, eq=False)
class Session:
    """Recorded insertions, in the order in which they were made within each session.

    Attributes:
        recordings: The insertions.
        guide_order: When the guide moves between two steps.
        origin: Where the recordings are from: sources, frame, and what was found on import.
        places: Place of each insertion among all of its session, from 0, where these are a selection.
    """

    recordings: tuple[Recording, ...]
    guide_order: GuideOrder = "before"
    origin: Mapping[str, Any] = field(default_factory=dict)
    places: tuple[int, ...] | None = None

    @property
    def axes(self) -> int:
        """Lateral axes."""
        return self.recordings[0].axes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sessions."""
        return tuple(dict.fromkeys(one.session for one in self.recordings))

    @property
    def order(self) -> tuple[int, ...]:
        """Place of each insertion within its session, from 0, also after a selection."""
        return self._ranks if self.places is None else self.places

    @cached_property
    def _ranks(self) -> tuple[int, ...]:
        """Place of each insertion among these of its session, from 0."""
        counts = dict.fromkeys(self.names, 0)
        places = []
        for one in self.recordings:
            places.append(counts[one.session])
            counts[one.session] += 1
        return tuple(places)

    @property
    def even(self) -> "Session":
        """The first, third, … insertion of each session."""
        return self.select([place % 2 == 0 for place in self._ranks])

    @property
    def odd(self) -> "Session":
        """The second, fourth, … insertion of each session."""
        return self.select([place % 2 == 1 for place in self._ranks])

    def of(self, name: str) -> "Session":
        """Return one of the sessions. Raises InputError for another name."""
        if name not in self.names:
            raise InputError(f"session = {name}: must be one of {', '.join(self.names)}")
        return self.select([one.session == name for one in self.recordings])

    def select(self, chosen: Sequence[bool]) -> "Session":
        """Return the insertions that are chosen."""
        kept = [n for n, keep in zip(range(len(self.recordings)), chosen, strict=True) if keep]
        places = tuple(self.order[n] for n in kept)
        return replace(self, recordings=tuple(self.recordings[n] for n in kept), places=places)

    def __repr__(self) -> str:
        steps = sum(len(one.depth) for one in self.recordings)
        return f"<Session {', '.join(self.names)}: {len(self.recordings)} insertions, {steps} steps>"

    def save(self, folder: Path) -> None:
        """Write `steps.parquet` and `session.toml` into a folder. Raises InputError if it cannot be created."""
        require_extra("study", "pyarrow")
        from pyarrow import table
        from pyarrow.parquet import write_table

        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{folder}: cannot be created: {error.strerror}: choose another folder"
            ) from None
        steps = BytesIO()
        write_table(table(to_columns(self.recordings)), steps)
        replace_file(folder / STEPS_FILE, steps.getvalue())
        if any(one.readings for one in self.recordings):
            keys = [(one.session, one.name) for one in self.recordings]
            rows = to_reading_columns(keys, [one.readings for one in self.recordings])
            write_table(table(rows), readings := BytesIO())
            replace_file(folder / READINGS_FILE, readings.getvalue())
        else:
            (folder / READINGS_FILE).unlink(missing_ok=True)
        head = {"format": _FORMAT, "axes": self.axes, "guide_order": self.guide_order, "origin": self.origin}
        replace_file(folder / SESSION_FILE, tomli_w.dumps(head).encode())


def load_session(folder: str | Path) -> Session:
    """Return the session of a folder of `flexneedle import`. Raises InputError if it has none, or a damaged one."""
    require_extra("study", "pyarrow")
    from pyarrow.parquet import read_table

    folder = Path(folder)
    try:
        head = tomllib.loads((folder / SESSION_FILE).read_text(encoding="utf-8"))
        columns = {name: column.to_numpy() for name, column in read_columns(read_table(folder / STEPS_FILE))}
    except (OSError, ValueError) as error:  # of TOML, UTF-8 and Arrow
        raise InputError(f"{folder}: not a session: {error}") from None
    for key, choices in {"format": (_FORMAT,), "axes": (1, 2), "guide_order": get_args(GuideOrder)}.items():
        if head.get(key) not in choices:
            rule = f"must be {' or '.join(map(str, choices))}"
            raise InputError(f"{folder}: {SESSION_FILE}: {key} = {head.get(key)}: {rule}")
    try:
        recordings = tuple(from_columns(columns, head["axes"]))
    except KeyError as error:
        raise InputError(f"{folder}: {STEPS_FILE}: has no column {error}") from None
    except InputError as error:
        raise InputError(f"{folder}: {STEPS_FILE}: {error}") from None
    recordings = tuple(_with_readings(folder / READINGS_FILE, recordings))
    return Session(recordings, head["guide_order"], head.get("origin", {}))


def _with_readings(path: Path, recordings: Sequence[Recording]) -> Iterator[Recording]:
    """Yield recordings with the readings of sensors along the needle. Raises InputError for a damaged table."""
    from pyarrow.parquet import read_table

    if not path.exists():
        yield from recordings
        return
    steps = {(one.session, one.name): len(one.depth) for one in recordings}
    try:
        columns = {name: column.to_numpy() for name, column in read_columns(read_table(path))}
        found = from_reading_columns(columns, steps)
    except KeyError as error:
        raise InputError(f"{path}: has no column {error}") from None
    except (OSError, ValueError, TypeError, InputError) as error:  # of Arrow, text for a number
        raise InputError(f"{path}: {error}") from None
    yield from (replace(one, readings=found.get((one.session, one.name), ())) for one in recordings)


def read_columns(rows: Any) -> Iterator[tuple[str, Any]]:
    """Yield the columns of an Arrow table."""
    return zip(rows.column_names, rows.columns, strict=True)


def to_columns(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Return the columns of the table: session, insertion, step, time_s, x_mm, then y and z of each quantity."""
    sizes = [len(one.depth) for one in recordings]
    columns: dict[str, Any] = {
        "session": np.repeat([one.session for one in recordings], sizes),
        "insertion": np.repeat([one.name for one in recordings], sizes),
        "step": np.concatenate([np.arange(size) for size in sizes]),
        "time_s": np.concatenate([one.time for one in recordings]),
        "x_mm": np.concatenate([one.depth for one in recordings]),
        "roll_rad": np.concatenate([one.roll for one in recordings]),
    }
    for name in _NUMBERS:
        values = np.concatenate([getattr(one, name) for one in recordings])
        for k, column in enumerate(_columns(name, values.shape[1])):
            columns[column] = values[:, k]
    return columns


def from_columns(columns: Mapping[str, Any], axes: int) -> Iterator[Recording]:
    """Yield the recordings of columns as of `to_columns`.

    Raises KeyError for a missing column, InputError for values that are no numbers or not finite.
    """
    keys = list(zip(columns["session"], columns["insertion"], strict=True))
    if not keys:
        raise InputError("has no rows")
    single = {"time": "time_s", "depth": "x_mm", "roll": "roll_rad"}
    numbers = {key: _numbers(columns, column) for key, column in single.items()}
    for kind in _NUMBERS:
        numbers[kind] = np.stack([_numbers(columns, column) for column in _columns(kind, axes)], axis=1)
    for (session, name), group in groupby(range(len(keys)), key=keys.__getitem__):
        rows = np.array([*group])
        yield Recording(str(session), str(name), **{key: values[rows] for key, values in numbers.items()})


def _numbers(columns: Mapping[str, Any], name: str) -> Floats:
    """Return a column of finite numbers, or NaN in times and slopes."""
    values = columns[name]
    if values.dtype.kind not in "fiu":
        raise InputError(f"column {name}: must have numbers, not {values.dtype}")
    wrong = np.isinf(values) if name.startswith(("time", "slope")) else ~np.isfinite(values)
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(f"column {name}, row {row + 1} of {len(wrong)}: {values[row]}: must be finite")
    found: Floats = values.astype(float)
    return found


def _columns(name: str, axes: int) -> list[str]:
    stem = "" if name == "position" else f"{name}_"
    return [f"{stem}{axis}_{_UNITS[name]}" for axis in _ACROSS[:axes]]
