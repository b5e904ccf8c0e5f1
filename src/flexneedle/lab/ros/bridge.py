"""Connection of an insertion to ROS: publishes its events, and receives stops, arms and targets."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from flexneedle.errors import RigError
from flexneedle.lab.link.bridge import CHECK_S, LinkBridge
from flexneedle.lab.link.records import LinkArm
from flexneedle.lab.rig.rig_file import RosSettings
from flexneedle.lab.ros.client import open_node
from flexneedle.lab.ros.profile import TopicProfile, load_profile
from flexneedle.lab.ros.zones import make_clearance, make_zones
from flexneedle.loop.events import Planned
from flexneedle.planning.events import Event
from flexneedle.results import Period
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.simulator.zones import NO_ZONES, zones_of
from flexneedle.types import Point


def load_checked_profile(settings: RosSettings) -> TopicProfile:
    """Return the profile of a section `ros`. Raises RigError if it lacks the topic of an arm or target."""
    profile = load_profile(settings.profile)
    for key in ("arm", "target"):
        if getattr(settings, key) and getattr(profile.subscribe, key) is None:
            rule = f"must list subscribe.{key}, since ros.{key} = true"
            raise RigError(to_line(Problem("ros.profile", settings.profile, rule)))
    return profile


class Bridge(LinkBridge):
    """The connection of one insertion to ROS, as a `LinkBridge`, which may also arm the rig.

    Args:
        settings: Section `ros` of a rig file.
        show: Prints a line for the user; called in the thread of the insertion only.

    Raises RigError for the profile, InputError or RunError if the node does not start.
    """

    hears_ros_stops = True
    protocol, stop_source = "ROS", "ROS topic"

    def __init__(self, settings: RosSettings, show: Callable[[str], None] = lambda _line: None) -> None:
        profile = load_checked_profile(settings)
        self.settings, self._read, self._armed = settings, profile.subscribe, threading.Event()
        self._zones = NO_ZONES
        super().__init__(lambda epoch: open_node(profile, epoch=epoch), {"profile": settings.profile}, show)

    @property
    def _stops_if_lost(self) -> bool:
        return self.settings.arm  # the operator at ROS could not stop the rig

    def __call__(self, event: Event) -> None:
        """Publish an event, and the zones of a plan, as a `LinkBridge`."""
        if isinstance(event, Planned) and (scenario := event.plan.scenario) is not None and scenario.zone:
            self._zones = zones_of(scenario)
            self._node.publish(make_zones(scenario))
        super().__call__(event)

    def _publish_period(self, period: Period) -> None:
        super()._publish_period(period)
        if (near := make_clearance(self._zones, period)) is not None:
            self._node.publish(replace(near, time=near.time + (self._shift or 0.0)))

    def await_target(self) -> Point:
        """Wait for a target x, y, z (mm) on its topic. Raises StoppedError after a stop, RunError without the node."""
        return self._await_target(f"a target on {self._topic('target')}").point

    def confirm(self, rig: Any) -> None:
        """Forward stops to the supervisor of a rig from now on; with `settings.arm`, wait for an arm.

        Earlier arms do not count. Raises StoppedError after a stop.
        """
        super().confirm(rig)
        if not self.settings.arm:
            return
        self._wait_for("arm", f"an arm on {self._topic('arm')}; nothing moves before it")
        while not self._armed.is_set():
            rig.wait(CHECK_S)
            self.check()
        self._awaited = ""

    def _topic(self, key: str) -> str:
        topic: str = getattr(self._read, key).topic
        return topic

    def _take(self, record: Any) -> None:
        if not isinstance(record, LinkArm):
            super()._take(record)
        elif self._awaited == "arm" and not self._armed.is_set():
            self._note(f"arm on {record.source}")
            self._armed.set()
        else:
            self._note_others(f"arm on {record.source}: ignored, not awaited")
