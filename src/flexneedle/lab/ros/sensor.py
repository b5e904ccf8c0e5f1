"""The sensor `ros`: curvatures of a fibre, points along the needle, or one point, on a topic.

Points have a stamp in the header. Curvatures have no header: theirs is the stamp with which the publisher's DDS sent
them. The clock of stamps is known from the message that arrived with the least delay (`link.stamps`), and this delay is
the scenario's `delay_s`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flexneedle.errors import RigError
from flexneedle.lab.link.sensing import LateMs, find_late_s
from flexneedle.lab.rig.devices.fbg.mounting import GratingSettings, SiteMap
from flexneedle.lab.rig.devices.fbg.stream import SHARPEST
from flexneedle.lab.rig.devices.sources import declare_sources
from flexneedle.lab.rig.rig_file import SensorSection, check_settings
from flexneedle.lab.ros.client import NodeClient
from flexneedle.lab.ros.profile import CURVATURES, POINT, POSE, SHAPE, TopicProfile, load_part
from flexneedle.lab.ros.receiver import TopicReceiver
from flexneedle.lab.ros.records import Received
from flexneedle.ports import Clock
from flexneedle.scenario.problems import Problem, to_line
from flexneedle.scenario.sections.fields import Section, Title
from flexneedle.scenario.sensors.fbg import Fbg
from flexneedle.scenario.sensors.points import Points
from flexneedle.scenario.sensors.sensor import Sensor
from flexneedle.scenario.sensors.slice import Slice
from flexneedle.types import VISIBLE, Reading

_TYPES: Mapping[type[Sensor], tuple[str, ...]] = {
    Fbg: (CURVATURES,),
    Points: (SHAPE, POINT, POSE),
    Slice: (POINT, POSE),
}


class RosSensorSettings(Section):
    """Keys beside `name` and `kind = "ros"` in a table `[[sensor]]` of a rig file."""

    profile: str = "neutral"
    """Name or file of the profile."""
    topic: Title | None = None
    """Name of the topic among `sensors` of the profile. Not set: the name of the sensor."""
    late_ms: LateMs | None = None
    """Time without a reading after which the status is not ok. Not set: three periods of `rate_hz`, at least 250."""


class RosFbgSettings(RosSensorSettings, GratingSettings):
    """The same for a sensor of the scenario with `kind = "fbg"`."""


class RosSensor(TopicReceiver[Reading]):
    """The port `NeedleSensor` of positions on the topic `key` of a node."""

    noun = "reading"

    def __init__(self, node: NodeClient, clock: Clock, late_s: float, key: str, delay: float) -> None:
        super().__init__(node, clock, late_s)
        self._key, self._delay = key, delay

    def _explain(self, silent: float) -> str:
        return self._refused or self._node.obstacles.get(self._key) or super()._explain(silent)

    def _make(self, record: Received) -> Reading | None:
        if not isinstance(record, Reading):
            return None
        return Reading(record.time + self._offset - self._delay, record.rows, record.status)


class RosFbg(RosSensor):
    """The port `NeedleSensor` of curvatures on the topic `key` of a node."""

    def __init__(
        self, node: NodeClient, clock: Clock, late_s: float, key: str, delay: float, sites: SiteMap
    ) -> None:
        super().__init__(node, clock, late_s, key, delay)
        self._map = sites

    def _make(self, record: Received) -> Reading | None:
        if not isinstance(record, Reading):
            return None
        time, have = record.time + self._offset - self._delay, len(record.rows)
        if have != self._map.gratings:
            return Reading(time, (), f"curvatures of {have} gratings, positions_mm has {self._map.gratings}")
        pairs = np.array(record.rows)
        pairs[~(np.abs(pairs) <= SHARPEST).all(axis=1)] = np.nan
        rows = self._map.to_rows(pairs[:, 0] + 1j * pairs[:, 1])
        return Reading(time, rows, VISIBLE if rows else "no value is valid")


def _find_sources(part: SensorSection) -> set[str]:
    own = {key: part.settings[key] for key in ("profile", "topic") if key in part.settings}
    name, profile = _load_topic(check_settings(RosSensorSettings, own), part.name)
    return profile.sensors[name].sources


def _load_topic(given: RosSensorSettings, title: str) -> tuple[str, TopicProfile]:
    name = given.topic or title
    return name, load_part(given.profile, sensors=(name,))


@declare_sources(_find_sources)
def make_sensor(settings: Mapping[str, Any], clock: Clock, sensor: Sensor) -> RosSensor:
    """Return the sensor of the settings of a rig file, for a sensor of the scenario, with times on `clock`.

    Raises RigError for invalid settings, or a profile without the topic or with a type that does not fit, InputError if
    cyclonedds is not installed, RunError if the node does not start.
    """
    fits = next((types for kind, types in _TYPES.items() if isinstance(sensor, kind)), ())
    if not fits:
        raise RigError(
            f'{sensor.title} of the scenario has kind = "{sensor.kind}": must be fbg, points or slice'
        )
    given = check_settings(RosFbgSettings if isinstance(sensor, Fbg) else RosSensorSettings, settings)
    name, profile = _load_topic(given, sensor.title)
    if (found := profile.sensors[name].type) not in fits:
        rule = f'has the type {found}: must be {" or ".join(fits)} for kind = "{sensor.kind}" of the scenario'
        raise RigError(to_line(Problem("topic", name, rule)))
    key, late = f"sensors.{name}", find_late_s(given.late_ms, sensor.rate_hz)
    if isinstance(sensor, Fbg) and isinstance(given, RosFbgSettings):
        sites = SiteMap(given.positions_mm, sensor.sites_mm, given)
        return RosFbg(NodeClient(profile), clock, late, key, sensor.delay_s, sites)
    return RosSensor(NodeClient(profile), clock, late, key, sensor.delay_s)
