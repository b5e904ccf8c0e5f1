"""The tracker `ros`: the tip on a topic."""

from collections.abc import Mapping
from time import monotonic
from typing import Any, Literal, Self

from flexneedle.lab.link.fields import DeviceAge
from flexneedle.lab.link.records import LinkRefusal
from flexneedle.lab.rig.rig_file import check_settings
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.profile import load_part
from flexneedle.lab.ros.records import Received, TipReading
from flexneedle.ports import Clock
from flexneedle.scenario.sections.fields import Section
from flexneedle.types import TIP, VISIBLE, Frame, SensorReading


class RosTrackerSettings(Section):
    """Settings beside `kind = "ros"` in the section `tracker`."""

    profile: str = "neutral"
    """Name or file of the profile."""
    source: Literal["tip", "shape"] = "tip"
    """Topic of the tip, or of a shape with the tip as its last pose."""
    late_ms: DeviceAge = 250.0
    """Time without a frame after which the tracker's status is not ok."""


class RosTracker:
    """A tracker with one sensor, the tip, in the frame of the insertion.

    A message is never returned twice, nor after a newer one. Frames have the numbers of their messages in the order of
    arrival; a refused message has a number, too. While no message is accepted, `status` is the reason.
    """

    def __init__(self, node: NodeClient, clock: Clock, late_s: float) -> None:
        self._node, self._late = node, late_s
        self._offset = clock.now() - monotonic()
        self._last, self._refused = monotonic(), ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the node."""
        self._node.close()

    def read(self) -> tuple[Frame, ...]:
        """Return the frames since the last call, oldest first; may be empty."""
        tips = [self._take_tip(one) for one in self._node.poll()]
        frames = [self._to_frame(tip) for tip in tips if tip is not None]
        if frames:
            self._last, self._refused = monotonic(), ""
        return tuple(frames)

    @property
    def status(self) -> str:
        """VISIBLE while frames arrive, otherwise the reason in a few words."""
        silent = monotonic() - self._last
        if self._node.status != VISIBLE:
            return self._node.status
        return VISIBLE if silent < self._late else self._refused or f"no frame for {silent:.1f} s"

    def _take_tip(self, record: Received) -> TipReading | None:
        if isinstance(record, LinkRefusal):
            self._refused = f"{record.source}: {record.reason}"
        return record if isinstance(record, TipReading) else None

    def _to_frame(self, tip: TipReading) -> Frame:
        reading = SensorReading(tip.position, tip.orientation, None, tip.status)
        return Frame(tip.time + self._offset, tip.number, {TIP: reading})


def make_tracker(settings: Mapping[str, Any], clock: Clock) -> RosTracker:
    """Return the tracker of the settings of a rig file, with times on `clock`.

    Raises RigError for invalid settings or a profile without the topic, InputError if cyclonedds is not installed,
    RunError if the node does not start.
    """
    given = check_settings(RosTrackerSettings, settings)
    profile = load_part(given.profile, subscribe=(given.source,))
    return RosTracker(NodeClient(profile), clock, 1e-3 * given.late_ms)
