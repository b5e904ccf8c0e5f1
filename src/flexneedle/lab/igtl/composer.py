"""Messages of an insertion, made from its records: geometry in RAS (mm) of the image, or in the needle's frame."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import dist, hypot, isnan
from typing import Any

import numpy as np

from flexneedle.geometry.rigid import Rigid, identity
from flexneedle.lab.igtl.messages import (
    Message,
    NamedPoint,
    PointMessage,
    PolylineMessage,
    StatusMessage,
    StringMessage,
    Trajectory,
    TrajectoryMessage,
    TransformMessage,
)
from flexneedle.lab.igtl.records import InsertionResult
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.link.records import LinkState
from flexneedle.results import Period, Plan
from flexneedle.types import Floats, Matrix, Point, Pose, X, Z

SHAPE, POINTS, PREDICTED = "Needle", "NeedlePoints", "PredictedNeedle"
TIP, GUIDE, PATH, STATUS, ERROR = "NeedleTip", "NeedleGuide", "NeedlePath", "NeedleStatus", "NeedleError"
"""Device names."""
UNKNOWN_AGE = -1
"""Subcode of a STATUS before the first reading."""
_OK, _ERROR = 1, 2  # codes of a STATUS
_LONGEST_NAME = 20  # bytes


@dataclass
class IgtlComposer:
    """Makes messages; keeps the last plan and state.

    epoch: Unix time (s) of the records' time 0; registration: of the image, None if it is not known.
    """

    epoch: float = 0.0
    registration: ImageRegistration | None = None
    _plan: Plan | None = field(default=None, init=False)
    _state: LinkState = field(default=LinkState(0.0, "idle"), init=False)
    _ahead: float | None = field(default=None, init=False)  # of the records' time before this process's
    _read_at: float | None = field(default=None, init=False)  # time of the newest accepted reading
    _seen_at: float = field(default=0.0, init=False)  # when the period arrived
    _seen_age: float = field(default=0.0, init=False)  # age of the reading then

    def begin(self, registration: ImageRegistration | None) -> None:
        """Begin an insertion: the readings of the last one are no longer new."""
        self.registration = registration
        self._plan = self._read_at = None

    def compose(self, record: object, now: float) -> Iterator[Message]:
        """Yield the messages of a record, at a time (s) of this process; none for a record of another kind."""
        match record:
            case Plan():
                self._plan = record
                yield from self._make_path(record)
            case Period():
                self._keep(record, now)
                yield from self._make_geometry(record)
                yield self._make_string(record.time, self._describe_error(record))
                yield self.make_status(now)
            case LinkState():
                self._state, self._ahead = record, record.time - now
                yield self.make_status(now)
            case InsertionResult(time, text):
                yield self._make_string(time, text)

    def make_status(self, now: float) -> StatusMessage:
        """Return state, age of the newest accepted reading and frame, at a time (s) of this process."""
        state = self._state
        age = None if self._read_at is None else self._seen_age + now - self._seen_at
        reading = "no reading yet" if age is None else f"newest reading {age:.2f} s old"
        frame = "in the needle's frame: no registration" if self.registration is None else "in the image, RAS"
        text = f"{state.state}: {state.reason}" if state.reason else state.state
        return StatusMessage(
            name=STATUS,
            time=self._stamp(0.0 if self._ahead is None else now + self._ahead),
            code=_OK if state.good else _ERROR,
            subcode=UNKNOWN_AGE if age is None else round(1e3 * age),
            error=state.state.encode()[:_LONGEST_NAME].decode(errors="ignore"),
            text=f"{text}; {reading}; {frame}".replace("\0", ""),
        )

    # Details

    @property
    def _to_peer(self) -> Rigid:
        return identity() if self.registration is None else self.registration.inverse()

    def _stamp(self, time: float) -> float:
        return max(0.0, self.epoch + time)

    def _keep(self, period: Period, now: float) -> None:
        if period.verdict.ok:
            self._read_at = period.measurement.time
        if self._read_at is not None:
            self._seen_at, self._seen_age = now, max(0.0, period.time - self._read_at)

    def _make_path(self, plan: Plan) -> Iterator[Message]:
        off = 0j if plan.scenario is None else plan.scenario.entry.lateral(0.0)
        entry, target = self._map(np.array([(0.0, off.real, off.imag), plan.target]))
        path = Trajectory(name="Plan", entry=entry, target=target)
        yield TrajectoryMessage(name=PATH, time=self._stamp(0.0), trajectories=(path,))

    def _make_geometry(self, period: Period) -> Iterator[Message]:
        header: dict[str, Any] = {"time": self._stamp(period.time)}
        points = self._map(period.shape[:, X : Z + 1])
        named = tuple(NamedPoint(name=str(k), position=point) for k, point in enumerate(points))
        yield TransformMessage(name=TIP, matrix=self._map_pose(period.estimate), **header)
        yield PolylineMessage(name=SHAPE, points=points, **header)
        yield PointMessage(name=POINTS, points=named, **header)
        if period.predicted is not None:
            ahead = self._map(period.predicted.nodes[:, X : Z + 1])
            yield PolylineMessage(name=PREDICTED, points=ahead, **header)
        plan = self._plan
        if plan is not None and plan.scenario is not None and plan.scenario.setup.guide_x is not None:
            guide = Pose(plan.scenario.setup.guide_x, *period.guide, 0.0, 0.0)
            yield TransformMessage(name=GUIDE, matrix=self._map_pose(guide), **header)

    def _describe_error(self, period: Period) -> str:
        if self._plan is None:
            return ""
        ahead = f"{dist(period.estimate.point, self._plan.target):.2f} mm to the target"
        miss = hypot(*period.miss)
        return ahead if isnan(miss) else f"{ahead}, predicted miss {miss:.2f} mm"

    def _make_string(self, time: float, text: str) -> StringMessage:
        return StringMessage(name=ERROR, time=self._stamp(time), text=text)

    def _map(self, points: Floats) -> tuple[Point, ...]:
        return tuple((x, y, z) for x, y, z in self._to_peer.apply(points).tolist())

    def _map_pose(self, pose: Pose) -> Matrix:
        """Return the matrix (4, 4) of a pose, whose x axis is the needle's."""
        to_peer = self._to_peer
        matrix = np.eye(4)
        matrix[:3, :3] = to_peer.rotation @ turn_from_x(np.array(pose.axis))
        matrix[:3, 3] = to_peer.apply(np.array(pose.point))
        return tuple(map(tuple, matrix.tolist()))


def turn_from_x(axis: Floats) -> Floats:
    """Return the smallest rotation (3, 3) of x to a unit vector (3,) other than −x."""
    x, y, z = axis.tolist()
    across = np.array([[0.0, -y, -z], [y, 0.0, 0.0], [z, 0.0, 0.0]])
    turned: Floats = np.eye(3) + across + across @ across / (1.0 + x)
    return turned
