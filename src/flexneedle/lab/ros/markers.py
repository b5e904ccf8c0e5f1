"""Markers of a scene: layers of tissue as boxes, the target as a ball with the radius of the paper's target circle."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros

from flexneedle.lab.ros.frames import FrameMap
from flexneedle.lab.ros.records import RosClearance, RosZones, ZoneSurface
from flexneedle.record.messages import Header, PointMessage, PoseMessage, Time, Vector3
from flexneedle.results import Plan
from flexneedle.types import Point

Marker = ros.visualization_msgs__msg__Marker
MarkerArray = ros.visualization_msgs__msg__MarkerArray
Color = ros.std_msgs__msg__ColorRGBA

TARGET_RADIUS_MM = 1.0
_PAST_TARGET_MM = 20.0  # the last layer is drawn to this depth
_HALF_WIDTH_MM = 30.0
_LAYERS = ((0.96, 0.80, 0.69), (0.90, 0.62, 0.55), (0.84, 0.72, 0.55), (0.75, 0.55, 0.60))
_ALPHA = 0.25
_NOTHING = Time(0, 0)
_ZONE, _ZONE_ALPHA, _MARGIN_ALPHA = (0.42, 0.30, 0.58), 0.8, 0.2
_BLACK = (0.1, 0.1, 0.1, 1.0)
_LINE_MM, _TEXT_MM = 0.3, 3.0  # width of a line, height of letters
_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LayerBox:
    """A layer between two depths (mm)."""

    name: str
    begin: float
    end: float


@dataclass(frozen=True)
class MarkerScene:
    """The surroundings of the needle; target None: not known."""

    layers: tuple[LayerBox, ...] = ()
    target: Point | None = None


def make_scene(plan: Plan) -> MarkerScene:
    """Return the layers and the target of a plan; no layers if it has no scenario."""
    tissue = () if plan.scenario is None else plan.scenario.tissue
    deepest = plan.target[0] + _PAST_TARGET_MM
    ends = accumulate(layer.thickness_mm or 0.0 for layer in tissue[:-1])
    depths = [0.0, *(min(end, deepest) for end in ends), deepest]
    spans = zip(tissue, depths, depths[1:], strict=False)
    layers = tuple(LayerBox(one.name, begin, end) for one, begin, end in spans if end > begin)
    return MarkerScene(layers, plan.target)


def make_markers(header: Header, frame: FrameMap, scene: MarkerScene) -> MarkerArray:
    """Return all markers of a scene; the topic is latched, so that each message must be complete."""
    return MarkerArray([*_make_boxes(header, frame, scene.layers), *_make_ball(header, frame, scene.target)])


def _make_boxes(header: Header, frame: FrameMap, layers: tuple[LayerBox, ...]) -> Iterator[Any]:
    for number, layer in enumerate(layers):
        middle = (layer.begin + layer.end) / 2, 0.0, 0.0
        size = layer.end - layer.begin, 2 * _HALF_WIDTH_MM, 2 * _HALF_WIDTH_MM
        colour = (*_LAYERS[number % len(_LAYERS)], _ALPHA)
        box = _make_marker(header, frame, middle, size, colour)
        box.ns, box.id, box.type, box.text = "tissue", number, Marker.CUBE, layer.name
        yield box


def _make_ball(header: Header, frame: FrameMap, target: Point | None) -> Iterator[Any]:
    if target is not None:
        ball = _make_marker(header, frame, target, (2 * TARGET_RADIUS_MM,) * 3, (0.8, 0.1, 0.1, 0.9))
        ball.ns, ball.type, ball.text = "target", Marker.SPHERE, "target"
        yield ball


def make_zone_markers(header: Header, frame: FrameMap, zones: RosZones) -> MarkerArray:
    """Return the markers of zones and of their margins, as triangles."""
    return MarkerArray(
        [_make_surface(header, frame, number, one) for number, one in enumerate(zones.surfaces)]
    )


def _make_surface(header: Header, frame: FrameMap, number: int, surface: ZoneSurface) -> Any:
    alpha = _MARGIN_ALPHA if surface.is_margin else _ZONE_ALPHA
    marker = _make_marker(header, frame, _ORIGIN, _ORIGIN, (*_ZONE, alpha))
    marker.scale = Vector3(1.0, 1.0, 1.0)  # of the points, which have the unit of the frame
    marker.ns, marker.id, marker.type = (
        "margins" if surface.is_margin else "zones",
        number,
        Marker.TRIANGLE_LIST,
    )
    marker.text, marker.points = surface.name, _make_points(frame, surface.corners.tolist())
    return marker


def make_clearance_markers(header: Header, frame: FrameMap, near: RosClearance) -> MarkerArray:
    """Return a line from the needle to the nearest zone, and the clearance as text."""
    line = _make_marker(header, frame, _ORIGIN, (_LINE_MM, 0.0, 0.0), _BLACK)
    line.ns, line.type = "clearance", Marker.LINE_LIST
    line.points = _make_points(frame, [near.needle, near.surface])
    text = _make_marker(header, frame, near.needle, (0.0, 0.0, _TEXT_MM), _BLACK)
    text.ns, text.id, text.type = "clearance", 1, Marker.TEXT_VIEW_FACING
    text.text = f"{near.clearance:.2f} mm to {near.zone}"
    return MarkerArray([line, text])


def _make_points(frame: FrameMap, points: Iterable[Sequence[float]]) -> list[PointMessage]:
    """Return points x, y, z (mm), along the axes of the insertion, in the unit of the frame."""
    return [PointMessage(*(1e-3 * frame.per_metre * value for value in point)) for point in points]


def _make_marker(
    header: Header, frame: FrameMap, middle: Point, size: Point, colour: tuple[float, ...]
) -> Any:
    """Return a marker with axes along the axes of the insertion; lengths in mm."""
    at = PoseMessage(frame.map_point(PointMessage(*(1e-3 * value for value in middle))), frame.axes)
    return Marker(
        header=header,
        ns="",
        id=0,
        type=Marker.CUBE,
        action=Marker.ADD,
        pose=at,
        scale=Vector3(*(1e-3 * frame.per_metre * value for value in size)),
        color=Color(*colour),
        lifetime=ros.builtin_interfaces__msg__Duration(0, 0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=ros.sensor_msgs__msg__CompressedImage(Header(_NOTHING, ""), "", np.empty(0, np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=ros.visualization_msgs__msg__MeshFile("", np.empty(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
