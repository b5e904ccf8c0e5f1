"""A scenario with one zone of each shape about the synthetic path."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np

from flexneedle import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.zones import DistanceGrid, FileZone, Workspace

SPHERE = {"name": "node", "shape": "sphere", "center_mm": [25.0, 9.0, 0.0], "radius_mm": 3.0}
CAPSULE = {
    "name": "vessel", "shape": "capsule", "from_mm": [12.0, -12.0, -8.0], "to_mm": [18.0, -5.0, 8.0],
    "radius_mm": 1.5, "margin_mm": 1.0,
}  # fmt: skip
BOX = {
    "name": "rib", "shape": "box", "center_mm": [8.0, 8.0, 2.0], "size_mm": [3.0, 6.0, 10.0],
    "rotation": [0.9238795325112867, 0.0, 0.0, 0.3826834323650898],
}  # fmt: skip
HALF_SPACE = {"name": "bone", "shape": "half-space", "point_mm": [48.0, 0.0, 0.0], "normal": [-1.0, 0.1, 0.0]}
PRIMITIVES = (SPHERE, CAPSULE, BOX, HALF_SPACE)


def with_zones(base: str | Scenario = "phantom", *zones: dict) -> Scenario:
    """Return a scenario with zones (default: one of each primitive)."""
    scenario = load_scenario(base) if isinstance(base, str) else base
    return scenario.with_values({"zone": list(zones or PRIMITIVES)})


class GridReader:
    """A reader of zone files whose zone is a ring about the axis: distances on a grid over the workspace.

    The ring has a radius of 6 mm about the point x = 30 mm, and is 2 mm thick; the grid errs by 0.1 mm.
    """

    def __call__(self, _zone: object, _to_needle: object, workspace: Workspace) -> FileZone:
        """Return the distances from the ring."""
        spacing = 0.5
        counts = np.ceil((workspace.high - workspace.low) / spacing).astype(int) + 1
        axes = [low + spacing * np.arange(count) for low, count in zip(workspace.low, counts, strict=True)]
        x, y, z = np.meshgrid(*axes, indexing="ij")
        values = np.hypot(np.hypot(y, z) - 6.0, x - 30.0) - 2.0
        return FileZone(DistanceGrid(values, workspace.low, spacing, 0.1), None)


@contextmanager
def grid_files(folder: Path) -> Iterator[dict]:
    """Yield the table of a zone in a file, with `GridReader` as the reader of files."""
    path = folder / "ring.nrrd"
    path.write_text("read by GridReader")
    with patch("flexneedle.simulator.zones.load_part", lambda *_: GridReader()):
        yield {"name": "ring", "shape": "file", "file": str(path), "segment": "ring"}
