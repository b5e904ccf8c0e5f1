"""The tracker `ros`: the tip on a topic."""

from collections.abc import Mapping
from typing import Any, Literal

from flexneedle.lab.link.fields import DeviceAge
from flexneedle.lab.rig.devices.sources import declare_sources
from flexneedle.lab.rig.rig_file import DeviceSection, check_settings
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.profile import load_part
from flexneedle.lab.ros.receiver import TopicReceiver
from flexneedle.lab.ros.records import Received, TipReading
from flexneedle.ports import Clock
from flexneedle.scenario.sections.fields import Section
from flexneedle.types import TIP, Frame, SensorReading


class RosTrackerSettings(Section):
    """Settings beside `kind = "ros"` in the section `tracker`."""

    profile: str = "neutral"
    """Name or file of the profile."""
    source: Literal["tip", "shape"] = "tip"
    """Topic of the tip, or of a shape with the tip as its last pose."""
    late_ms: DeviceAge = 250.0
    """Time without a frame after which the tracker's status is not ok."""


class RosTracker(TopicReceiver[Frame]):
    """A tracker with one sensor, the tip, in the frame of the insertion.

    A message is never returned twice, nor after a newer one. Frames have the numbers of their messages in the order of
    arrival; a refused message has a number, too.
    """

    noun = "frame"

    def _make(self, record: Received) -> Frame | None:
        if not isinstance(record, TipReading):
            return None
        reading = SensorReading(record.position, record.orientation, None, record.status)
        return Frame(record.time + self._offset, record.number, {TIP: reading})


def _find_sources(part: DeviceSection) -> set[str]:
    given = check_settings(RosTrackerSettings, part.settings)
    return load_part(given.profile, subscribe=(given.source,)).find_sources(given.source)


@declare_sources(_find_sources)
def make_tracker(settings: Mapping[str, Any], clock: Clock) -> RosTracker:
    """Return the tracker of the settings of a rig file, with times on `clock`.

    Raises RigError for invalid settings or a profile without the topic, InputError if cyclonedds is not installed,
    RunError if the node does not start.
    """
    given = check_settings(RosTrackerSettings, settings)
    profile = load_part(given.profile, subscribe=(given.source,))
    return RosTracker(NodeClient(profile), clock, 1e-3 * given.late_ms)
