"""Files for 3D Slicer of runs: markups, models of needle and zones, and the transform to the image's frame."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from flexneedle.arguments import check_path
from flexneedle.errors import InputError
from flexneedle.geometry.quaternion import to_matrix
from flexneedle.geometry.rigid import Rigid
from flexneedle.lab.images.distances import matrix
from flexneedle.lab.images.markups import CURVE, POINTS, ControlPoint, Markup, write_markups
from flexneedle.lab.images.meshes import Mesh, write_mesh
from flexneedle.lab.images.surfaces import find_surface, make_tube
from flexneedle.lab.images.transforms import write_transform
from flexneedle.mechanics.zones import fill_distances
from flexneedle.planning.entry_map import EntryMap
from flexneedle.results import Insertion, Plan
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.zones import ZoneMap, zones_of_record
from flexneedle.types import Floats

NEEDLE, TRANSFORM = "needle.ply", "needle-to-image.tfm"
_ENTRIES = 10  # of a map, the best
_APART_MM = 1e-3  # of points of a curve
_BESIDE_MM, _SPACING_MM = 40.0, 1.0  # of the surfaces of zones


def write_scene(run: Insertion | dict[str, Plan], folder: Path) -> list[Path]:
    """Write the files of an insertion, or of plans by strategy, in the frame of the scenario's image; return them.

    The frame is the needle's if the scenario has no image. A zone is left out if its file is missing or has changed.
    Raises InputError for a folder that contains an export or cannot be created, RecordError if a file cannot be
    written.
    """
    plans = {run.plan.strategy: run.plan} if isinstance(run, Insertion) else run
    scenario = _scenario_of(run, next(iter(plans.values())))
    shape = _shape_of(run, next(iter(plans.values())))
    needle = make_tube(_distinct(shape), 0.5 * scenario.needle.outer_diameter)
    return _write(scenario, [*_markups(scenario, run, plans, shape)], {NEEDLE: needle}, folder)


def write_entries(found: EntryMap, folder: Path) -> list[Path]:
    """Write the best entries of a map, with their clearance and tolerance, and the zones, as `write_scene` does."""
    best = found.best(_ENTRIES)
    points = np.insert(found.points[best], 0, 0.0, axis=1)
    markup = _markup(POINTS, "entries", [_describe_entry(found, k) for k in best], points)
    return _write(found.scenario, [markup], {}, folder)


def _describe_entry(found: EntryMap, entry: int) -> str:
    tolerance = f"tolerance {found.offset_mm[entry]:.1f} mm, {found.angle_mrad[entry]:.0f} mrad"
    name = found.zone_name(entry)
    return f"{found.clearance_mm[entry]:.1f} mm from {name}, {tolerance}" if name else tolerance


def _write(
    scenario: Scenario, markups: Sequence[Markup], meshes: dict[str, Mesh], folder: Path
) -> list[Path]:
    """Write the transform to the image's frame, markups, meshes and zones."""
    to_image = image_frame(scenario).inverse()
    path = check_path("folder", folder)
    if (path / TRANSFORM).exists():  # its zones and paths would be beside these
        raise InputError(f"{path}: already contains an export ({TRANSFORM}): choose another folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be created: {error.strerror}") from None
    write_transform(matrix(to_image), path / TRANSFORM)
    names = [f"{_plain(each.name)}.mrk.json" for each in markups]
    for name, markup in zip(
        names, markups, strict=True
    ):  # older versions of 3D Slicer read the first one of a file
        write_markups([_map_markup(markup, to_image)], path / name)
    meshes = {**meshes, **dict(_zones(scenario))}
    for name, mesh in meshes.items():
        write_mesh(Mesh(to_image.apply(mesh.points), mesh.triangles), path / name)
    return [path / name for name in (*names, *meshes, TRANSFORM)]


def image_frame(scenario: Scenario) -> Rigid:
    """Return the map from the image's frame, RAS, to the needle's."""
    return Rigid(to_matrix(np.array(scenario.image.rotation)), np.array(scenario.image.translation_mm))


def has_image(scenario: Scenario) -> bool:
    """Return whether the scenario has an image, whose frame differs from the needle's."""
    frame = image_frame(scenario)
    return bool((frame.rotation != np.eye(3)).any() or frame.translation.any())


def _scenario_of(run: Insertion | dict[str, Plan], plan: Plan) -> Scenario:
    found = (run.scenario if isinstance(run, Insertion) else None) or plan.scenario
    if found is None:
        raise InputError("the run has no scenario, whose frame the files need")
    return found


def _shape_of(run: Insertion | dict[str, Plan], plan: Plan) -> Floats:
    """Return points (n, 3) of the needle at the end: estimated in an insertion, else planned."""
    poses = run.periods[-1].shape if isinstance(run, Insertion) and run.periods else plan.shapes[-1]
    points: Floats = np.asarray(poses)[:, :3]
    return points


def _markups(
    scenario: Scenario, run: Insertion | dict[str, Plan], plans: dict[str, Plan], shape: Floats
) -> Iterator[Markup]:
    """Yield the markups in the needle's frame."""
    first = next(iter(plans.values()))
    entry = (first.scenario or scenario).entry
    points = {"entry": (0.0, entry.lateral_mm, entry.lateral_z_mm), "target": first.target}
    yield _markup(POINTS, "entry and target", list(points), np.array([*points.values()], dtype=float))
    for strategy, plan in plans.items():
        name = "planned path" if len(plans) == 1 else f"planned path, {strategy}"
        yield _curve(name, plan.tips[:, :3])
    if isinstance(run, Insertion) and run.periods:
        yield _curve("executed path", np.array([each.estimate[:3] for each in run.periods]))
        true = np.array([each.true_tip[:3] for each in run.periods if each.true_tip is not None])
        if len(true):
            yield _curve("true path", true)
    yield _curve("needle shape", shape)


def _curve(name: str, points: Floats) -> Markup:
    rows = _distinct(points)
    return _markup(CURVE, name, [str(number) for number in range(1, len(rows) + 1)], rows)


def _distinct(points: Floats) -> Floats:
    """Return points (n, 3) without those near the one before."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) > _APART_MM:
            kept.append(point)
    return np.array(kept)


def _markup(kind: str, name: str, labels: Sequence[str], rows: Floats) -> Markup:
    points = (ControlPoint(label, (x, y, z)) for label, (x, y, z) in zip(labels, rows.tolist(), strict=True))
    return Markup(kind, name, tuple(points))


def _map_markup(markup: Markup, to_image: Rigid) -> Markup:
    labels = [point.label for point in markup.points]
    return _markup(markup.kind, markup.name, labels, to_image.apply(markup.positions))


def _zones(scenario: Scenario) -> Iterator[tuple[str, Mesh]]:
    """Yield name and surface of each zone that is not lost, and of its margin with what is added to it."""
    zones = zones_of_record(scenario)
    entry, depth = scenario.entry, scenario.setup.max_depth
    low = np.array([0.0, entry.lateral_mm - _BESIDE_MM, entry.lateral_z_mm - _BESIDE_MM])
    counts = np.ceil((np.array([depth, 2.0 * _BESIDE_MM, 2.0 * _BESIDE_MM])) / _SPACING_MM).astype(int) + 1
    rows = low + _SPACING_MM * np.indices(tuple(counts.tolist())).reshape(3, -1).T
    if not zones:
        return
    found = _distances(zones, rows).reshape(-1, *counts)
    for number, name in enumerate(zones.names):
        reach = float(zones.margins[number] + zones.added[number])
        for suffix, beyond in (("", 0.0), ("-margin", reach)):
            surface = find_surface(found[number] - beyond, low, _SPACING_MM)
            if surface is not None:
                yield f"zone-{number + 1}-{_plain(name)}{suffix}.ply", surface


def _distances(zones: ZoneMap, points: Floats) -> Floats:
    """Return distances (z, n) of points (n, 3) from the zones themselves, without what is added."""
    found = np.empty((len(zones.names), len(points)))
    fill_distances(zones.exact, np.ascontiguousarray(points), found)
    distances: Floats = found + zones.added[:, None]
    return distances


def _plain(name: str) -> str:
    return re.sub(r"[^\w]+", "-", name).strip("-").lower() or "unnamed"
