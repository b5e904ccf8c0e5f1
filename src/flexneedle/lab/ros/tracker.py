"""The tracker `ros`: the tip on a topic."""

from collections.abc import Mapping
from time import monotonic
from typing import Any, Self

from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.records import Refused, Request, ShapeReading, TipReading
from flexneedle.lab.ros.settings import TrackerSettings, checked, profile_with
from flexneedle.phantom.tracking.table import TIP
from flexneedle.ports import Clock
from flexneedle.types import VISIBLE, Frame, SensorReading


class RosTracker:
    """A tracker of one sensor, the tip, in the frame of the insertion as the profile places it.

    A message is never returned twice, nor an older one than the last. Frames are numbered as messages arrived, those
    that were refused included. While none is accepted `status` is the reason.
    """

    def __init__(self, node: NodeClient, clock: Clock, late_s: float) -> None:
        self._node, self._late = node, late_s
        self._offset = clock.now() - monotonic()
        self._last, self._refused = monotonic(), ""
        self._reason = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the node."""
        self._node.close()

    def read(self) -> tuple[Frame, ...]:
        """The frames since the last call, oldest first; may be empty."""
        frames = [self._frame(one) for one in map(self._tip, self._node.poll()) if one is not None]
        if frames:
            self._last, self._refused = monotonic(), ""
        return tuple(frames)

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, else the reason in a few words."""
        silent = monotonic() - self._last
        if self._node.status != VISIBLE:
            return self._node.status
        return VISIBLE if silent < self._late else self._refused or f"no frame for {silent:.1f} s"

    def _tip(self, request: Request) -> TipReading | None:
        if isinstance(request, Refused):
            self._refused = f"{request.topic}: {request.reason}"
        if isinstance(request, ShapeReading):
            return request.tip
        return request if isinstance(request, TipReading) else None

    def _frame(self, tip: TipReading) -> Frame:
        reading = SensorReading(tip.position, tip.orientation, None, tip.status)
        return Frame(tip.time + self._offset, tip.number, {TIP: reading})


def make_tracker(settings: Mapping[str, Any], clock: Clock) -> RosTracker:
    """Return the tracker of the settings of a rig file, times on `clock`.

    Raises RigError for invalid settings or a profile without the topic, InputError if cyclonedds is not installed,
    RunError if the node does not start.
    """
    given = checked(settings, TrackerSettings)
    profile = profile_with(given.profile, f"subscribe.{given.source}")
    return RosTracker(NodeClient(profile), clock, 1e-3 * given.late_ms)
