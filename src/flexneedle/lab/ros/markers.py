"""Markers of a scene: layers of tissue as boxes, the target as a ball of the paper's target circle."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros

from flexneedle.lab.ros.frames import FrameMap
from flexneedle.record.messages import Header, PointMessage, PoseMessage, Time, Vector3
from flexneedle.types import Plan, Point

Marker = ros.visualization_msgs__msg__Marker
MarkerArray = ros.visualization_msgs__msg__MarkerArray
Color = ros.std_msgs__msg__ColorRGBA

TARGET_RADIUS_MM = 1.0
_PAST_TARGET_MM = 20.0  # depth to which the last layer is drawn
_HALF_WIDTH_MM = 30.0
_LAYERS = ((0.96, 0.80, 0.69), (0.90, 0.62, 0.55), (0.84, 0.72, 0.55), (0.75, 0.55, 0.60))
_SEE_THROUGH = 0.25
_NOTHING = Time(0, 0)


@dataclass(frozen=True)
class Layer:
    """A layer from one depth to another (mm)."""

    name: str
    begin: float
    end: float


@dataclass(frozen=True)
class Scene:
    """What is around the needle; target None: not known."""

    layers: tuple[Layer, ...] = ()
    target: Point | None = None


def scene_of(plan: Plan) -> Scene:
    """The layers and the target of a plan; no layers if it has no scenario."""
    tissue = () if plan.scenario is None else plan.scenario.tissue
    deepest = plan.target[0] + _PAST_TARGET_MM
    ends = accumulate(layer.thickness_mm or 0.0 for layer in tissue[:-1])
    depths = [0.0, *(min(end, deepest) for end in ends), deepest]
    spans = zip(tissue, depths, depths[1:], strict=False)
    return Scene(tuple(Layer(one.name, begin, end) for one, begin, end in spans if end > begin), plan.target)


def markers(header: Header, frame: FrameMap, scene: Scene) -> MarkerArray:
    """All markers of a scene; the topic is latched, so each message has all of them."""
    return MarkerArray([*_boxes(header, frame, scene.layers), *_balls(header, frame, scene.target)])


def _boxes(header: Header, frame: FrameMap, layers: tuple[Layer, ...]) -> Iterator[Any]:
    for number, layer in enumerate(layers):
        middle = (layer.begin + layer.end) / 2, 0.0, 0.0
        size = layer.end - layer.begin, 2 * _HALF_WIDTH_MM, 2 * _HALF_WIDTH_MM
        colour = (*_LAYERS[number % len(_LAYERS)], _SEE_THROUGH)
        yield _marker(header, frame, "tissue", number, Marker.CUBE, middle, size, colour, layer.name)


def _balls(header: Header, frame: FrameMap, target: Point | None) -> Iterator[Any]:
    if target is not None:
        size = (2 * TARGET_RADIUS_MM,) * 3
        yield _marker(header, frame, "target", 0, Marker.SPHERE, target, size, (0.8, 0.1, 0.1, 0.9), "target")


def _marker(
    header: Header,
    frame: FrameMap,
    group: str,
    number: int,
    kind: int,
    middle: Point,
    size: Point,
    colour: tuple[float, ...],
    text: str,
) -> Any:
    """A marker with its own axes along those of the insertion; lengths in mm."""
    at = PoseMessage(frame.point(PointMessage(*(1e-3 * value for value in middle))), frame.axes)
    return Marker(
        header=header,
        ns=group,
        id=number,
        type=kind,
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
        text=text,
        mesh_resource="",
        mesh_file=ros.visualization_msgs__msg__MeshFile("", np.empty(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
