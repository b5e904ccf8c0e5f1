"""Sources of data of the devices of a rig file: no data may be used twice, as of a shape and its own curvatures."""

from collections.abc import Callable, Collection, Iterator
from typing import Any, TypeVar

from flexneedle.errors import InputError
from flexneedle.lab.rig.devices.opening import SENSORS, TRACKERS
from flexneedle.lab.rig.rig_file import DeviceSection, RigFile
from flexneedle.plugins import load_part
from flexneedle.scenario.problems import Problem

Factory = TypeVar("Factory", bound=Callable[..., Any])
FindSources = Callable[[Any], Collection[str]]
"""Returns the names of the sources of a section `tracker` or `sensor`; may raise RigError for its settings."""


def declare_sources(find: FindSources) -> Callable[[Factory], Factory]:
    """Return a decorator of a factory of trackers or sensors whose devices have sources."""

    def declare(factory: Factory) -> Factory:
        declared: Any = factory
        declared.find_sources = find
        return factory

    return declare


def source_problems(rig: RigFile) -> Iterator[Problem]:
    """Yield the sensors along the needle that have a source in common with the tracker or an earlier sensor."""
    owners = dict.fromkeys(_find_sources(TRACKERS, rig.tracker), "the tracker")
    for n, part in enumerate(rig.sensor):
        sources = _find_sources(SENSORS, part)
        if both := sorted(set(sources) & set(owners)):
            rule = f"{owners[both[0]]} also has data from {both[0]}: use one of the two"
            yield Problem(("sensor", n, "name"), part.name, rule)
        owners |= dict.fromkeys(sources, f"sensor {part.name}")


def _find_sources(group: str, part: DeviceSection) -> Collection[str]:
    """Return the sources of a device; none if it declares none, or cannot be opened, which opening it reports."""
    try:
        find: FindSources | None = getattr(load_part(part.kind, (), group), "find_sources", None)
        return () if find is None else find(part)
    except InputError:
        return ()
