"""Record of the true states of an emulated rig: a CSV file that is written continuously, and its reader."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from flexneedle.errors import InputError, RunError, make_printable
from flexneedle.types import Floats

_TIP = ("x_mm", "y_mm", "z_mm", "theta_rad", "psi_rad")
_REST = ("strain_energy_mj", "least_stretch", "converged", "lag_ms")
_ROTATION = "rotation"


def column_names(axes: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of a record of these axes."""
    counts = (f"{name}_counts" for name in axes)
    positions = (f"{name}_{_unit(name)}" for name in axes)
    return ("time_s", *counts, *positions, *_TIP, *_REST)


def _unit(axis: str) -> str:
    return "deg" if axis == _ROTATION else "mm"


class TruthRow(NamedTuple):
    """True state at a time (s, monotonic clock).

    Travel of the motors (counts) and positions of the axes (mm, rad) in the order of the axes; pose of the tip (5,);
    strain energy (mJ), least stretch and convergence until this row; lag (s).
    """

    time: float
    counts: Sequence[float]
    positions: Sequence[float]
    tip: Floats
    strain_energy: float
    least_stretch: float
    converged: bool
    lag: float


class TruthWriter:
    """Writer of a record of these axes to a new file, each row at once. Use it as a context manager.

    Raises InputError if the file exists or cannot be created, RunError if a row cannot be written.
    """

    def __init__(self, path: Path, axes: Sequence[str]) -> None:
        self._axes, self._path = tuple(axes), path
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise InputError(f"{path}: already exists: choose another file, or remove it") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be created: {error.strerror}") from None
        self._write(column_names(axes))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._file.close()

    def write(self, row: TruthRow) -> None:
        """Write a row."""
        shown = [
            degrees(place) if name == _ROTATION else place
            for name, place in zip(self._axes, row.positions, strict=True)
        ]
        counts = (round(count, 3) for count in row.counts)
        numbers = (*counts, *shown, *row.tip.tolist(), row.strain_energy, row.least_stretch)
        last = int(row.converged), f"{1e3 * row.lag:.3f}"
        self._write((f"{row.time:.6f}", *(f"{value:.9g}" for value in numbers), *last))

    def _write(self, cells: Sequence[object]) -> None:
        line = (",".join(map(str, cells)) + "\n").encode()
        try:
            written = self._file.write(line)
        except OSError as error:
            raise RunError(f"{self._path}: cannot be written: {error.strerror}") from None
        if written != len(line):
            raise RunError(f"{self._path}: cannot be written: the disk is full")


@dataclass(frozen=True, eq=False)
class TruthRecord:
    """Columns of a record.

    Times (n,) in s on the monotonic clock; by name of the axis the travel of its motor since power-on (counts) and
    its position (mm, rad), each (n,); poses x, y, z, θ, ψ of the tip (n, 5); strain energy of the tissue (mJ), least
    stretch until each row, convergence of all steps, and lag of the phantom (s), each (n,).
    """

    time: Floats
    counts: Mapping[str, Floats]
    positions: Mapping[str, Floats]
    tips: Floats
    strain_energy: Floats
    least_stretch: Floats
    converged: Floats
    lag: Floats

    def tip_at(self, times: Floats | float) -> Floats:
        """Return the poses (…, 5) of the tip at times (s), linear between rows.

        Raises InputError for times outside of the record.
        """
        wanted = np.asarray(times, dtype=float)
        if wanted.size and not (self.time[0] <= wanted.min() and wanted.max() <= self.time[-1]):
            raise InputError(f"times must be from {self.time[0]:.3f} to {self.time[-1]:.3f} s")
        return np.stack([np.interp(wanted, self.time, column) for column in self.tips.T], axis=-1)


def read_truth(path: Path) -> TruthRecord:
    """Return the record in a file of `emulate rig --truth`, also while it is written: its last row may be incomplete.

    Raises InputError: file, rule.
    """
    try:
        text = path.read_text(encoding="utf-8")
        head, *rows = text[: text.rfind("\n") + 1].splitlines() or [""]
        names = tuple(head.split(","))
        axes = [name.removesuffix("_counts") for name in names if name.endswith("_counts")]
        if names != column_names(axes) or not rows:
            raise InputError(f"{path}: must have the columns of emulate rig --truth, and a row")
        columns = np.loadtxt(rows, delimiter=",", ndmin=2, unpack=True)
        if len(columns) != len(names):
            raise InputError(f"{path}: all rows must have {len(names)} cells")
        table = dict(zip(names, columns, strict=True))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # also of a file that is no text
        raise InputError(f"{path}: {make_printable(str(error))}") from None
    positions = {name: table[f"{name}_{_unit(name)}"] for name in axes}
    return TruthRecord(
        table["time_s"],
        {name: table[f"{name}_counts"] for name in axes},
        {name: np.radians(place) if name == _ROTATION else place for name, place in positions.items()},
        np.stack([table[name] for name in _TIP], axis=-1),
        table["strain_energy_mj"],
        table["least_stretch"],
        table["converged"],
        1e-3 * table["lag_ms"],
    )
