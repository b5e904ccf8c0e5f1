"""Checking the connection of a rig to ROS 2: who publishes what it reads. It publishes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from flexneedle.lab.rig.check import Finding, with_device
from flexneedle.lab.rig.rig_file import Part, RigFile, RosSettings
from flexneedle.lab.ros.bridge import profile_of
from flexneedle.lab.ros.client import check_installed
from flexneedle.lab.ros.profile import OF_THE_LOOP, Profile
from flexneedle.ports import Clock

if TYPE_CHECKING:
    from flexneedle.lab.ros.listening import Heard, Listener

_SHARED = "diagnostics"  # ROS nodes publish it together


def check_ros(rig: RigFile, clock: Clock, seconds: float) -> list[Finding]:
    """Return what was found on the topics of the section `ros` in `seconds`; none without it. clock: real time.

    A domain that cannot be joined is a finding, too.
    """
    settings = rig.ros
    if settings is None:
        return []
    return with_device(
        "ros",
        settings.profile,
        lambda: _listener(settings),
        lambda listener: _findings(rig, settings, listener, clock, seconds),
    )


def _listener(settings: RosSettings) -> Listener:
    """Raises RigError for the profile, InputError or RunError if the domain cannot be joined."""
    profile = profile_of(settings)
    check_installed()
    from flexneedle.lab.ros.listening import Listener

    return Listener(profile)


def _findings(
    rig: RigFile, settings: RosSettings, listener: Listener, clock: Clock, seconds: float
) -> list[Finding]:
    heard = listener.heard(clock, seconds)
    return [
        Finding("ros", "other participants", str(listener.others)),
        *(_of_topic(one, one.key in _used(rig, settings), seconds) for one in heard),
        *_rivals(profile_of(settings), listener),
    ]


def _of_topic(heard: Heard, used: bool, seconds: float) -> Finding:
    """What is wrong with a topic that the rig does not use is no problem of the rig."""
    counted = (
        _counted(heard.publishers, "publisher"),
        f"{_counted(heard.messages, 'message')} in {seconds:g} s",
    )
    age = "" if heard.age is None else f", the last {heard.age:.2f} s old"
    found = f"{heard.topic}, {heard.kind}: {', '.join(counted)}{age}"
    if used:
        return Finding("ros", heard.key, found, heard.problem)
    return Finding("ros", heard.key, "; ".join(filter(None, (f"{found}; not used", heard.problem))))


def _counted(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"


def _used(rig: RigFile, settings: RosSettings) -> set[str]:
    """Keys of `subscribe` that the rig reads: for the insertion, and for a driver and a tracker of the same topics."""
    parts = (rig.driver, "joint_states"), (rig.tracker, str(rig.tracker.settings.get("source", "tip")))
    devices = (key for part, key in parts if _profile(part) == settings.profile)
    return {"stop", "arm", *devices, *(("target",) if settings.target else ())}


def _profile(part: Part) -> str | None:
    """The profile of a driver or tracker of topics; None for another."""
    return str(part.settings.get("profile", "neutral")) if part.kind == "ros" else None


def _rivals(profile: Profile, listener: Listener) -> Iterator[Finding]:
    """Topics that the insertion would publish, and another node does."""
    for key in OF_THE_LOOP[0]:
        topic = getattr(profile.publish, key)
        if topic is not None and key != _SHARED and listener.publishes(topic.topic):
            yield Finding("ros", key, topic.topic, "another node publishes it, as the insertion will")
