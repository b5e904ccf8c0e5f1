"""ROS 2 messages of a run: standard types, SI units (m, rad, s, J, N), poses in the frame `skin`.

The frame `skin` has its origin at the intersection of the insertion axis with the skin, x into the tissue, y and z
across it, right-handed. The orientation of a pose is the smallest rotation that turns the x axis into the needle's.
Time is the run's and starts at 0.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import cos, hypot, pi, sin

import numpy as np
import rosbags.typesys.stores.ros2_humble as ros
from rosbags.typesys import Stores, get_typestore

from flexneedle.types import Floats, Matrix, Point, Pose

Time = ros.builtin_interfaces__msg__Time
DiagnosticArray = ros.diagnostic_msgs__msg__DiagnosticArray
DiagnosticStatus = ros.diagnostic_msgs__msg__DiagnosticStatus
KeyValue = ros.diagnostic_msgs__msg__KeyValue
PointMessage = ros.geometry_msgs__msg__Point
PoseMessage = ros.geometry_msgs__msg__Pose
PoseStamped = ros.geometry_msgs__msg__PoseStamped
PoseWithCovariance = ros.geometry_msgs__msg__PoseWithCovariance
PoseWithCovarianceStamped = ros.geometry_msgs__msg__PoseWithCovarianceStamped
Quaternion = ros.geometry_msgs__msg__Quaternion
Vector3 = ros.geometry_msgs__msg__Vector3
Vector3Stamped = ros.geometry_msgs__msg__Vector3Stamped
Path = ros.nav_msgs__msg__Path
JointState = ros.sensor_msgs__msg__JointState
Float64 = ros.std_msgs__msg__Float64
Float64MultiArray = ros.std_msgs__msg__Float64MultiArray
MultiArrayDimension = ros.std_msgs__msg__MultiArrayDimension
MultiArrayLayout = ros.std_msgs__msg__MultiArrayLayout
Header = ros.std_msgs__msg__Header

FRAME = "skin"
JOINTS = ["base_x", "base_y", "base_z", "base_theta", "base_psi", "guide_y", "guide_z", "roll"]
UNKNOWN_TURN = pi**2 / 3
"""Variance (rad²) of an unknown angle, uniform over −π to π."""
_METRES = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1e-3, 1e-3, 1.0])
STORE = get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True)
class Check:
    """Result of a check: a text, whether it is good, and values by key."""

    text: str
    good: bool
    values: Mapping[str, str]


Message = (
    PoseStamped
    | PoseWithCovarianceStamped
    | Path
    | JointState
    | Float64
    | Float64MultiArray
    | Vector3Stamped
    | DiagnosticArray
)


def nanoseconds(time: float) -> int:
    """Return a time (s) in whole ns."""
    return round(time * 1e9)


def pose(time: float, at: Pose) -> PoseStamped:
    """Return a pose at a time (s)."""
    return _pose_stamped(_header(time), at)


def uncertain_pose(time: float, at: Pose, covariance: Matrix) -> PoseWithCovarianceStamped:
    """Return a pose with the covariance (3, 3), mm², of its position; its orientation is unknown."""
    matrix = UNKNOWN_TURN * np.eye(6)
    matrix[:3, :3] = 1e-6 * np.array(covariance)
    stamped = pose(time, at)
    return PoseWithCovarianceStamped(stamped.header, PoseWithCovariance(stamped.pose, matrix.ravel()))


def path(time: float, poses: Floats) -> Path:
    """Return poses (n, 5), all with the same time (s)."""
    header = _header(time)
    return Path(header, [_pose_stamped(header, Pose.of(row)) for row in poses.tolist()])


def points(time: float, places: Floats) -> Path:
    """Return points (n, 3) as poses without an angle."""
    return path(time, np.pad(places, ((0, 0), (0, 2))))


def poses_of(message: Path) -> Floats:
    """Return the poses (n, 5) of a path."""
    return np.array([_row(stamped.pose) for stamped in message.poses]).reshape(-1, 5)


def joints(time: float, values: Iterable[float]) -> JointState:
    """Return values (mm, rad) of JOINTS as joint positions."""
    position = np.array([*values]) * _METRES
    return JointState(_header(time), JOINTS, position, np.empty(0), np.empty(0))


def number(value: float) -> Float64:
    """Return a number; it has the time of the log."""
    return Float64(float(value))


def table(values: Floats) -> Float64MultiArray:
    """Return lengths (n, k) in mm as an array of rows."""
    rows, columns = values.shape
    sizes = [MultiArrayDimension("node", rows, rows * columns), MultiArrayDimension("axis", columns, columns)]
    return Float64MultiArray(MultiArrayLayout(sizes, 0), 1e-3 * values.ravel())


def values_of(message: Float64MultiArray) -> Floats:
    """Return the lengths (n, k), mm, of an array of rows."""
    return 1e3 * message.data.reshape([size.size for size in message.layout.dim])


def vector(time: float, at: Point) -> Vector3Stamped:
    """Return a vector (mm)."""
    return Vector3Stamped(_header(time), Vector3(*(float(value) * 1e-3 for value in at)))


def diagnostics(
    time: float, name: str, values: Mapping[str, str], *, text: str = "", good: bool = True
) -> DiagnosticArray:
    """Return one status with its values by key; level OK, or WARN if it is not good."""
    return statuses(time, name, [Check(text, good, values)])


def statuses(time: float, name: str, checks: Iterable[Check]) -> DiagnosticArray:
    """Return a status for each check, all with the same name."""
    return named_statuses(time, [(name, one) for one in checks])


def named_statuses(time: float, checks: Iterable[tuple[str, Check]]) -> DiagnosticArray:
    """Return a status for each check, with its name."""
    return DiagnosticArray(_header(time), [_status(name, one) for name, one in checks])


def _status(name: str, check: Check) -> DiagnosticStatus:
    level = DiagnosticStatus.OK if check.good else DiagnosticStatus.WARN
    pairs = [KeyValue(key, value) for key, value in check.values.items()]
    return DiagnosticStatus(level, name, check.text, "", pairs)


def _header(time: float) -> Header:
    seconds, rest = divmod(nanoseconds(time), 1_000_000_000)
    return Header(Time(seconds, rest), FRAME)


def _pose_stamped(header: Header, at: Pose) -> PoseStamped:
    """Return a pose with the smallest rotation that turns x into the needle's axis: about an axis normal to x."""
    position = PointMessage(at.x * 1e-3, at.y * 1e-3, at.z * 1e-3)
    tilt, toward_y, toward_z = _polar(at.theta, at.psi)
    y, z = -sin(tilt / 2) * toward_z, sin(tilt / 2) * toward_y
    # The product has the sign of zero of a turn about z: in the plane the two are the same to the last bit.
    return PoseStamped(header, PoseMessage(position, Quaternion(0.0 * z, y, z, cos(tilt / 2))))


def _row(at: PoseMessage) -> list[float]:
    turn = at.orientation
    sine, toward_y, toward_z = _polar(turn.z, -turn.y)
    tilt = 2 * float(np.arctan2(sine, turn.w))
    position = (at.position.x * 1e3, at.position.y * 1e3, at.position.z * 1e3)
    return [*position, tilt * toward_y, tilt * toward_z]


def _polar(y: float, z: float) -> tuple[float, float, float]:
    """Return length and direction of a lateral vector; the direction of a zero vector is zero."""
    length = hypot(y, z)
    return (length, y / length, z / length) if length else (length, y, z)
