"""From a case file to a scenario in the needle's frame, with the lines that are printed about it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flexneedle.arguments import make_refusal
from flexneedle.errors import FileError, InputError, ScenarioError
from flexneedle.geometry.quaternion import from_matrix
from flexneedle.geometry.rigid import identity
from flexneedle.lab.images.case_file import ImageCase, LayerChoice, load_case
from flexneedle.lab.images.distances import check_square, find_extent, load_label_map
from flexneedle.lab.images.frames import ImageRegistration, describe_import
from flexneedle.lab.images.label_map import LabelMap, Segment
from flexneedle.lab.images.layers import Layers, find_layers
from flexneedle.lab.images.markups import LINE, Markup, read_markups
from flexneedle.lab.images.sampling import Sampler, disc, rays
from flexneedle.lab.images.skin import Skin, fit_skin
from flexneedle.scenario.alternatives import SHEAR, YOUNG
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.library import label
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.sections.zones import REGISTRATION_SDS
from flexneedle.simulator.zone_doubts import describe_image, find_zone_doubts
from flexneedle.simulator.zones import zones_of
from flexneedle.types import Floats

_SMALLEST_MM = 1.0  # distance of target and entry
_KEYS = "valid keys: "
_ABOVE_MM = 30.0  # the skin, in which zones are sought


@dataclass(frozen=True)
class ImportedCase:
    """A scenario by an image.

    lines: what was imported; doubts: what is outside of the model's assumptions, each with its size.
    """

    scenario: Scenario
    lines: tuple[str, ...]
    doubts: tuple[str, ...]


class _Points(NamedTuple):
    """Entry and target (3,) and unit vector (3,) of the insertion, RAS."""

    entry: Floats
    target: Floats
    direction: Floats


def import_case(path: str | Path) -> ImportedCase:
    """Return the scenario of a case file. Raises FileError, one line for each problem."""
    case = load_case(path)
    try:
        return _import(case, Path(path))
    except FileError as error:
        raise FileError(*(_with_opening(path, line) for line in error.problems)) from None
    except InputError as error:
        raise FileError(_with_opening(path, str(error))) from None


def _with_opening(path: str | Path, line: str) -> str:
    opening = f"{label(path)}: "
    return line if line.startswith(opening) else opening + line


def _import(case: ImageCase, path: Path) -> ImportedCase:
    base, image = load_scenario(case.scenario), load_label_map(Path(case.labels))
    sizes = check_square(image.affine)
    points = _find_points(case)
    beyond = float(find_extent(Path(case.labels), image, identity()).beyond(points.target))
    if beyond > 0.0:
        raise make_refusal(
            "target", case.target, f"must be in the label map, but is {beyond:.1f} mm beyond it"
        )
    skin = fit_skin(
        image, _segments(image, "skin", case.skin), points.entry, points.direction, case.skin_radius_mm
    )
    target = skin.to_needle.apply(points.target)
    sampler = Sampler(image, skin.to_needle.inverse())
    groups = [_segments(image, f"layer[{k}].segments", each.segments) for k, each in enumerate(case.layer)]
    for each in case.zone:
        _check_zone(sampler, image, each.segment, target)
    layers = find_layers(sampler, groups, float(target[0]), base.setup.max_depth, case.skin_radius_mm)
    scenario = _make_scenario(case, path, base, skin, target, layers)
    registration = _registration(case, skin)
    shape = " × ".join(map(str, image.labels.shape[1:]))
    edges = " × ".join(f"{size:.3g}" for size in sizes)
    lines = (
        f"label map {case.labels}: {shape} voxels of {edges} mm, {len(image.segments)} segments",
        *describe_import(registration, image.corners).splitlines(),
        *_describe(case, scenario, skin, layers),
    )
    extent = find_extent(Path(case.labels), image, skin.to_needle)
    about_images = dict.fromkeys([*describe_image(extent, scenario), *find_zone_doubts(scenario)])
    doubts = (*_doubts(case, scenario, skin, layers, sampler, image), *about_images)
    return ImportedCase(scenario.with_values({"image.doubts": "; ".join(doubts)}), lines, doubts)


def _find_points(case: ImageCase) -> _Points:
    """Return the points of a case. Raises InputError for a name that no markup has, or several."""
    markups = [markup for path in case.markups for markup in read_markups(path)]
    entry, target = (_find_point(markups, key, getattr(case, key)) for key in ("entry", "target"))
    way = target - entry
    apart = float(np.linalg.norm(way))
    if apart < _SMALLEST_MM:
        raise InputError(f"entry and target are {apart:.2g} mm apart: must be at least {_SMALLEST_MM:g} mm")
    direction = way / apart if case.direction is None else _find_direction(markups, case.direction)
    if way @ direction <= 0.0:
        raise make_refusal("direction", case.direction, "must lead from the entry towards the target")
    return _Points(entry, target, direction)


def _find_point(markups: Sequence[Markup], key: str, name: str) -> Floats:
    """Return the position (3,) of a point by its label, `MARKUP/POINT`, or the name of a markup with one point."""
    named = [
        ({point.label, f"{markup.name}/{point.label}", *([markup.name] * (len(markup.points) == 1))}, point)
        for markup in markups
        for point in markup.points
    ]
    found = [point for names, point in named if name in names]
    if len(found) != 1:
        choices = ", ".join(f"{markup.name}/{point.label}" for markup in markups for point in markup.points)
        rule = f"must name one point of the markups, here {len(found)} (points: {choices or 'none'})"
        raise make_refusal(key, name, rule)
    if found[0].position is None:
        raise make_refusal(key, name, "is not placed: place it in 3D Slicer")
    return np.array(found[0].position)


def _find_direction(markups: Sequence[Markup], name: str) -> Floats:
    """Return the unit vector (3,) along a line markup."""
    lines = [markup for markup in markups if markup.kind == LINE]
    found = [markup for markup in lines if markup.name == name]
    if len(found) != 1:
        names = ", ".join(markup.name for markup in lines) or "none"
        raise make_refusal(
            "direction", name, f"must name one line markup, here {len(found)} (lines: {names})"
        )
    first, last = found[0].positions
    length = float(np.linalg.norm(last - first))
    if length < _SMALLEST_MM:
        raise make_refusal("direction", name, f"must be at least {_SMALLEST_MM:g} mm long, here {length:.2g}")
    return np.asarray((last - first) / length)


def _segments(image: LabelMap, key: str, names: Sequence[str]) -> list[Segment]:
    try:
        return [image.find_segment(name) for name in names]
    except InputError as error:
        raise InputError(f"{key}: {error}") from None


def _check_zone(sampler: Sampler, image: LabelMap, name: str, target: Floats) -> None:
    """Raise InputError for a zone that contains the target, or no segment of this name."""
    segments = _segments(image, "zone", [name])
    if sampler.among(segments, target):
        raise make_refusal("zone", name, "contains the target")


def _registration(case: ImageCase, skin: Skin) -> ImageRegistration:
    w, x, y, z = from_matrix(skin.to_needle.rotation).tolist()
    p, q, r = skin.to_needle.translation.tolist()
    return ImageRegistration((w, x, y, z), (p, q, r), case.registration_sd_mm)


# ---- the scenario


def _make_scenario(
    case: ImageCase, path: Path, base: Scenario, skin: Skin, target: Floats, layers: Layers
) -> Scenario:
    """Return the scenario. Raises ScenarioError for what breaks its rules, such as a target out of reach."""
    registration, values = _registration(case, skin), base.values()
    x, y, z = (round(float(value), 6) + 0.0 for value in target)  # 0, not −0
    entry = {"lateral_mm": 0.0, "lateral_z_mm": 0.0, "slope_mrad": 0.0, "slope_z_mrad": 0.0}
    free = {
        key: value
        for key in ("free_radius_mm", "free_slope_mrad")
        if (value := getattr(case, key)) is not None
    }
    margin = {} if case.zone_margin_mm is None else {"margin_mm": case.zone_margin_mm}
    name = case.name or path.name.removesuffix(".toml")
    values |= {
        "name": name,
        "target": {"depth_mm": x, "lateral_mm": y, "lateral_z_mm": z},
        "entry": values["entry"] | entry | free,
        "image": {
            "rotation": list(registration.rotation),
            "translation_mm": list(registration.translation),
            "sd_mm": case.registration_sd_mm,
        },
        "zones": values["zones"] | margin,
        "zone": [*values.get("zone", []), *(_zone(case, each.segment, each.margin_mm) for each in case.zone)],
    }
    if case.layer:
        values["tissue"] = _tissue(case, base, layers)
    if not values["zone"]:
        del values["zone"]
    return Scenario.from_values(values)


def _zone(case: ImageCase, segment: str, margin: float | None) -> dict[str, Any]:
    from flexneedle.files import digest_of

    made = {"shape": "file", "name": segment, "file": case.labels, "segment": segment}
    return made | {"sha256": digest_of(Path(case.labels))} | ({} if margin is None else {"margin_mm": margin})


def _tissue(case: ImageCase, base: Scenario, layers: Layers) -> list[dict[str, Any]]:
    """Return the tables `[[tissue]]` of the layers on the axis; the last one has no thickness."""
    chosen = [_material(number, each, base) for number, each in enumerate(case.layer)]
    if not layers.runs:
        names = ", ".join(name for each in case.layer for name in each.segments)
        raise InputError(f"layer: none of the segments {names} is on the insertion axis below the skin")
    made = [chosen[each.choice] | {"thickness_mm": round(each.end - each.top, 6)} for each in layers.runs]
    made[-1].pop("thickness_mm")
    return made


def _material(number: int, choice: LayerChoice, base: Scenario) -> dict[str, Any]:
    """Return the table `[[tissue]]` of a choice, without thickness."""
    names = [each.name for each in base.tissue]
    key = f"layer[{number}]"
    if "thickness_mm" in choice.values:
        raise make_refusal(
            f"{key}.thickness_mm", choice.values["thickness_mm"], "leave it out: the image gives it"
        )
    if choice.tissue is not None and names.count(choice.tissue) != 1:
        rule = f"must name one [[tissue]] of the scenario ({', '.join(names)})"
        raise make_refusal(f"{key}.tissue", choice.tissue, rule)
    found = [
        name for name in names if name == choice.tissue or (choice.tissue is None and name in choice.segments)
    ]
    if not found and not choice.values:
        rule = f"missing: name a [[tissue]] of the scenario ({', '.join(names)}), or give its values"
        raise InputError(f"{key}.tissue: {rule}")
    start = base.tissue[names.index(found[0])].model_dump(mode="json", exclude_none=True) if found else {}
    replaced = {"thickness_mm", *([SHEAR] if YOUNG in choice.values else [])}
    kept = {name: value for name, value in start.items() if name not in replaced}
    made = kept | {"name": ", ".join(choice.segments)} | choice.values
    _check_layer(key, made)
    return made


def _check_layer(key: str, values: dict[str, Any]) -> None:
    """Raise ScenarioError, with the key of the choice, for values that are no `[[tissue]]`."""
    minimal = load_scenario("phantom").values() | {"tissue": [values]}
    try:
        Scenario.from_values(minimal)
    except ScenarioError as error:
        own = [line for line in error.problems if line.startswith("tissue[0]")]
        lines = [line.replace("tissue[0]", key).replace(_KEYS, f"{_KEYS}segments, tissue, ") for line in own]
        if lines:
            raise ScenarioError(*lines) from None


# ---- what is printed


def _describe(case: ImageCase, scenario: Scenario, skin: Skin, layers: Layers) -> Iterator[str]:
    """Yield lines about skin, target, layers and zones."""
    side = "below" if skin.entry > 0.0 else "above"
    yield (
        f"skin: plane within {case.skin_radius_mm:g} mm of {case.entry}, which is {abs(skin.entry):.1f} mm {side} it"
    )
    place = ", ".join(f"{value:z.2f}" for value in scenario.target.position)
    free = scenario.entry
    yield (
        f"target: {case.target} at x, y, z = {place} mm; entry free by {free.free_radius_mm:g} mm and "
        f"{free.free_slope_mrad:g} mrad"
    )
    if not case.layer:
        yield "layers: of the scenario, since the case has no [[layer]]"
    else:
        yield "layers on the insertion axis:"
        for each, tissue in zip(layers.runs, scenario.tissue, strict=True):
            end = "on" if each is layers.runs[-1] else f"to {each.end:.1f} mm"
            yield f"  from {each.top:.1f} {end}: {tissue.name}, shear modulus {tissue.shear_modulus_kpa:g} kPa"
    yield from _describe_zones(scenario)


def _describe_zones(scenario: Scenario) -> Iterator[str]:
    """Yield zones with their margins and what is added to these."""
    zones, registration = zones_of(scenario), REGISTRATION_SDS * scenario.image.sd_mm
    for name, margin, added in zip(zones.names, zones.margins, zones.added, strict=True):
        if name in zones.out_of_reach:
            yield f"zone to avoid: {name}, out of the needle's reach"
            continue
        parts = {"registration": registration, "voxels and contacts": added - registration}
        more = "".join(f" + {size:.2g} mm {of}" for of, size in parts.items() if size)
        yield f"zone to avoid: {name}, margin {margin:g} mm{more}"


def _doubts(
    case: ImageCase, scenario: Scenario, skin: Skin, layers: Layers, sampler: Sampler, image: LabelMap
) -> Iterator[str]:
    """Yield what the model, with a flat skin and layers at right angles to the insertion, does not have."""
    radius = scenario.entry.free_radius_mm
    shift = f", by {radius * math.tan(skin.tilt):.1f} mm at the edge of the free entry" if radius else ""
    yield f"skin: tilted by {math.degrees(skin.tilt):.1f} degrees{shift}"
    yield (
        f"skin: not flat, off its plane by {skin.rms:.1f} mm rms, {skin.most:.1f} mm at most, within "
        f"{case.skin_radius_mm:g} mm"
    )
    for each in layers.boundaries:
        name = ", ".join(case.layer[each.run.choice].segments)
        if math.isnan(each.tilt):
            yield f"layer {name}: its lower end is not found around the axis"
            continue
        yield (
            f"layer {name}: lower end tilted by {math.degrees(each.tilt):.1f} degrees, {each.least:.1f} to "
            f"{each.most:.1f} mm thick, within {case.skin_radius_mm:g} mm"
        )
        if each.share < 1.0:
            yield f"layer {name}: not on {100 * (1 - each.share):.0f} % of the lines within {case.skin_radius_mm:g} mm"
    for top, end in layers.gaps if case.layer else ():
        yield f"no layer from {top:.1f} to {end:.1f} mm: taken as part of the layer above"
    for thin in layers.thin:
        name = ", ".join(case.layer[thin.choice].segments)
        yield f"layer {name} at {thin.top:.1f} mm: {thin.end - thin.top:.1f} mm thick, left out"
    yield from _zones_above_skin(case, sampler, image)


def _zones_above_skin(case: ImageCase, sampler: Sampler, image: LabelMap) -> Iterator[str]:
    """Yield zones that are above the plane of the skin, where no distance from them is computed."""
    points = rays(disc(2.0 * case.skin_radius_mm, 1.5), np.arange(-_ABOVE_MM, 0.0, 0.5))
    for each in case.zone:
        found = sampler.among([image.find_segment(each.segment)], points)
        if found.any():
            yield f"zone {each.segment}: up to {-points[found][:, 0].min():.1f} mm above the plane of the skin, ignored"
