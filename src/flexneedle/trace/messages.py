"""ROS 2 messages of a run: standard types, SI units (m, rad, s, J, N), planar poses in the frame `skin`.

The frame `skin` has its origin at the intersection of the insertion axis with the skin, x into the tissue, y lateral,
z by the right-hand rule. Time is that of the run and starts at 0.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import cos, sin

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros
from rosbags.typesys import Stores, get_typestore

from flexneedle.types import Floats, Pose

Time = ros.builtin_interfaces__msg__Time
DiagnosticArray = ros.diagnostic_msgs__msg__DiagnosticArray
DiagnosticStatus = ros.diagnostic_msgs__msg__DiagnosticStatus
KeyValue = ros.diagnostic_msgs__msg__KeyValue
Point = ros.geometry_msgs__msg__Point
PoseMessage = ros.geometry_msgs__msg__Pose
PoseStamped = ros.geometry_msgs__msg__PoseStamped
Quaternion = ros.geometry_msgs__msg__Quaternion
Vector3 = ros.geometry_msgs__msg__Vector3
Vector3Stamped = ros.geometry_msgs__msg__Vector3Stamped
Path = ros.nav_msgs__msg__Path
JointState = ros.sensor_msgs__msg__JointState
Float64 = ros.std_msgs__msg__Float64
Header = ros.std_msgs__msg__Header

FRAME = "skin"
JOINTS = ["base_x", "base_y", "base_theta", "guide_y", "bevel"]
STORE = get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True)
class Check:
    """Result of a check: a text, whether it is good, and values by key."""

    text: str
    good: bool
    values: Mapping[str, str]


Message = PoseStamped | Path | JointState | Float64 | Vector3Stamped | DiagnosticArray


def nanoseconds(time: float) -> int:
    """Return a time (s) in whole ns."""
    return round(time * 1e9)


def pose(time: float, at: Pose) -> PoseStamped:
    """Return a planar pose (mm, mm, rad) at a time (s)."""
    return _pose_stamped(_header(time), at)


def path(time: float, poses: Floats) -> Path:
    """Return poses (n, 3) (mm, mm, rad), all with the same time (s)."""
    header = _header(time)
    return Path(header, [_pose_stamped(header, (x, y, theta)) for x, y, theta in poses.tolist()])


def points_of(message: Path) -> Floats:
    """Return the poses (n, 3) (mm, mm, rad) of a path."""
    return np.array([_planar(stamped.pose) for stamped in message.poses]).reshape(-1, 3)


def joints(time: float, values: Iterable[float]) -> JointState:
    """Return base_x, base_y, base_theta, guide_y, bevel (mm, mm, rad, mm, ±1) as joint positions."""
    base_x, base_y, base_theta, guide_y, bevel = values
    position = np.array([base_x * 1e-3, base_y * 1e-3, base_theta, guide_y * 1e-3, bevel])
    return JointState(_header(time), JOINTS, position, np.empty(0), np.empty(0))


def number(value: float) -> Float64:
    """Return a number; its time is that of the log."""
    return Float64(float(value))


def vector(time: float, x: float, y: float) -> Vector3Stamped:
    """Return a planar vector (mm)."""
    return Vector3Stamped(_header(time), Vector3(float(x) * 1e-3, float(y) * 1e-3, 0.0))


def diagnostics(
    time: float, name: str, values: Mapping[str, str], *, text: str = "", good: bool = True
) -> DiagnosticArray:
    """Return one status with its values by key; level OK, or WARN if it is not good."""
    return statuses(time, name, [Check(text, good, values)])


def statuses(time: float, name: str, checks: Iterable[Check]) -> DiagnosticArray:
    """Return a status for each check, all with the same name."""
    return DiagnosticArray(_header(time), [_status(name, one) for one in checks])


def _status(name: str, check: Check) -> DiagnosticStatus:
    level = DiagnosticStatus.OK if check.good else DiagnosticStatus.WARN
    pairs = [KeyValue(key, value) for key, value in check.values.items()]
    return DiagnosticStatus(level, name, check.text, "", pairs)


def _header(time: float) -> Header:
    seconds, rest = divmod(nanoseconds(time), 1_000_000_000)
    return Header(Time(seconds, rest), FRAME)


def _pose_stamped(header: Header, at: Pose) -> PoseStamped:
    x, y, theta = at
    quaternion = Quaternion(0.0, 0.0, sin(theta / 2), cos(theta / 2))
    return PoseStamped(header, PoseMessage(Point(x * 1e-3, y * 1e-3, 0.0), quaternion))


def _planar(at: PoseMessage) -> Pose:
    return at.position.x * 1e3, at.position.y * 1e3, 2 * float(np.arctan2(at.orientation.z, at.orientation.w))
