"""Check of a rig's connection to ROS 2. It publishes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from flexneedle.lab.rig.preflight.rig_check import Finding, check_device
from flexneedle.lab.rig.rig_file import DeviceSection, RigFile, RosSettings
from flexneedle.lab.ros.bridge import load_checked_profile
from flexneedle.lab.ros.client import check_installed
from flexneedle.lab.ros.profile import INSERTION_KEYS
from flexneedle.ports import Clock

if TYPE_CHECKING:
    from flexneedle.lab.ros.listener import TopicActivity, TopicListener

_SHARED = "diagnostics"  # published by all ROS nodes together


def check_ros(rig: RigFile, clock: Clock, seconds: float) -> list[Finding]:
    """Return findings about the topics of the section `ros` in `seconds`; none without it. clock: real time.

    A domain that cannot be joined is also a finding.
    """
    settings = rig.ros
    if settings is None:
        return []
    return check_device(
        "ros",
        settings.profile,
        lambda: _open_listener(settings),
        lambda listener: _find(rig, settings, listener, clock, seconds),
    )


def _open_listener(settings: RosSettings) -> TopicListener:
    """Join the domain. Raises RigError for the profile, InputError or RunError if the domain cannot be joined."""
    profile = load_checked_profile(settings)
    check_installed()
    from flexneedle.lab.ros.listener import TopicListener

    return TopicListener(profile)


def _find(
    rig: RigFile, settings: RosSettings, listener: TopicListener, clock: Clock, seconds: float
) -> list[Finding]:
    activities, used = listener.listen(clock, seconds), _list_used(rig, settings)
    return [
        Finding("ros", "other participants", str(listener.others)),
        *(_describe(one, one.key in used, seconds) for one in activities),
        *_find_rivals(settings, listener),
    ]


def _describe(activity: TopicActivity, used: bool, seconds: float) -> Finding:
    """Return the finding about a topic; only a problem of a used topic is a problem of the rig."""
    publishers, messages = _count(activity.publishers, "publisher"), _count(activity.messages, "message")
    age = "" if activity.age is None else f", the last {activity.age:.2f} s old"
    found = f"{activity.topic}, {activity.kind}: {publishers}, {messages} in {seconds:g} s{age}"
    if used:
        return Finding("ros", activity.key, found, activity.problem)
    return Finding("ros", activity.key, "; ".join(filter(None, (f"{found}; not used", activity.problem))))


def _count(number: int, noun: str) -> str:
    return f"{number or 'no'} {noun}{'' if number == 1 else 's'}"


def _list_used(rig: RigFile, settings: RosSettings) -> set[str]:
    """Return the used keys: for the insertion, and for a driver, tracker and sensors of the same topics."""
    parts = (
        (rig.driver, "joint_states"),
        (rig.tracker, str(rig.tracker.settings.get("source", "tip"))),
        *((one, f"sensors.{one.settings.get('topic', one.name)}") for one in rig.sensor),
    )
    devices = (key for part, key in parts if _get_profile(part) == settings.profile)
    return {"stop", "arm", *devices, *(("target",) if settings.target else ())}


def _get_profile(part: DeviceSection) -> str | None:
    """Return the profile of a driver or tracker of topics, None for others."""
    return str(part.settings.get("profile", "neutral")) if part.kind == "ros" else None


def _find_rivals(settings: RosSettings, listener: TopicListener) -> Iterator[Finding]:
    """Yield the topics of the insertion that another node publishes."""
    profile = load_checked_profile(settings)
    for key in INSERTION_KEYS["publish"]:
        topic = getattr(profile.publish, key)
        if topic is not None and key != _SHARED and listener.is_published(topic.topic):
            yield Finding("ros", key, topic.topic, "another node publishes it, as the insertion will")
