"""Recorded insertions with a known path: a bevel that curves it, a guide that turns the tip, a sensor with noise."""

from dataclasses import dataclass

import numpy as np

CURVATURE = np.array([6e-4, -3e-4])  # 1/mm, along y and z
RESPONSE = -0.02  # rad/mm: turn of the tip for a motion of the guide


@dataclass(frozen=True, eq=False)
class KnownPath:
    """Steps of an insertion in the needle's frame: depth (k,), lateral offset, slope and guide (k, 2), mm and rad."""

    depth: np.ndarray
    position: np.ndarray
    slope: np.ndarray
    guide: np.ndarray

    @property
    def points(self):
        return np.column_stack([self.depth, self.position])

    @property
    def axis(self):
        axis = np.column_stack([np.ones(len(self.depth)), self.slope])
        return axis / np.linalg.norm(axis, axis=1, keepdims=True)


def guided(steps=18, advance=5.0, seed=0, moves=3.0):
    """Return a path whose guide moves before each advance by up to `moves` mm."""
    random = np.random.default_rng(seed)
    guide = np.vstack([np.zeros(2), random.uniform(-moves, moves, (steps - 1, 2))])
    depth = advance * np.arange(steps)
    turns = RESPONSE * np.exp(-depth[1:, None] / 60.0) * np.diff(guide, axis=0)
    slope = np.vstack([np.zeros(2), np.cumsum(CURVATURE * advance + turns, axis=0)])
    position = np.vstack([np.zeros(2), np.cumsum(0.5 * advance * (slope[1:] + slope[:-1]), axis=0)])
    return KnownPath(depth, position, slope, guide)


def stream(path, rate=40.0, speed=5.0, rest=2.0, noise=0.0, seed=0):
    """Return times (r,), points (r, 3) and guide (r, 2) of a stop-and-go insertion along a path.

    The guide moves at `speed` at rest, then the tip advances.
    """
    random = np.random.default_rng(seed)
    times, points, guides = [0.0, rest], [path.points[0]] * 2, [path.guide[0]] * 2
    for k in range(1, len(path.depth)):
        for point, guide in ((path.points[k - 1], path.guide[k]), (path.points[k], path.guide[k])):
            length = np.linalg.norm(point - points[-1]) + np.linalg.norm(guide - guides[-1])
            times.append(times[-1] + length / speed)
            points.append(point)
            guides.append(guide)
        times.append(times[-1] + rest)
        points.append(path.points[k])
        guides.append(path.guide[k])
    time = np.arange(0.0, times[-1], 1.0 / rate)
    tip, moved = (
        np.stack([np.interp(time, times, each) for each in np.array(values).T], axis=1)
        for values in (points, guides)
    )
    return time, tip + noise * random.standard_normal(tip.shape), moved


PLAIN = {
    "tip": {"position": ["x", "y", "z"], "axis": ["ax", "ay", "az"]},
    "guide": {"y": "gy", "z": "gz"},
}
"""Map of `columns` in the needle's frame."""


def columns(path):
    """Return the columns t, x, y, z, ax, ay, az, gy, gz of the steps of a path, 10 s apart."""
    values = np.column_stack([path.points, path.axis, path.guide]).T
    names = ("x", "y", "z", "ax", "ay", "az", "gy", "gz")
    return {"t": 10.0 * np.arange(len(path.depth)), **dict(zip(names, values, strict=True))}


def write_csv(file, table, separator=",", before="", after="", decimal="."):
    """Write columns as text: lines before their names, and after the rows."""
    rows = [
        separator.join(str(value).replace(".", decimal) for value in row)
        for row in zip(*table.values(), strict=True)
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"{before}{separator.join(table)}\n" + "\n".join(rows) + f"\n{after}", encoding="utf-8")
    return file


def load(*files, **sections):
    """Return the import of files with a map of these sections, `PLAIN` unless given."""
    from flexneedle.lab.calibration.importing.importer import import_recordings
    from flexneedle.lab.calibration.importing.map_file import RecordingMap

    given = {key: value for key, value in (PLAIN | sections).items() if value is not None}
    return import_recordings(files, RecordingMap.model_validate(given))


def assert_steps(recording, path, atol=1e-6):
    """Assert that a recording has the steps of a path."""
    axes = recording.axes
    np.testing.assert_allclose(recording.depth, path.depth - path.depth[0], atol=atol)
    np.testing.assert_allclose(recording.position, (path.position - path.position[0])[:, :axes], atol=atol)
    np.testing.assert_allclose(recording.guide, (path.guide - path.guide[0])[:, :axes], atol=atol)
