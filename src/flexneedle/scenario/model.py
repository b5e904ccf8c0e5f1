"""The scenario: all inputs of plan and insertion, except the seed."""

from collections.abc import Collection, Mapping
from itertools import chain
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator

from flexneedle.arguments import make_refusal
from flexneedle.errors import ScenarioError
from flexneedle.scenario.alternatives import find_replaced, spell
from flexneedle.scenario.dotted import flatten, set_value, split_key
from flexneedle.scenario.problems import describe, key_path, refuse, to_line
from flexneedle.scenario.rules import (
    entry_problems,
    geometry_problems,
    grid_problems,
    layer_problems,
    monitor_problems,
    plan_problems,
    sensor_problems,
    target_problems,
    zone_problems,
)
from flexneedle.scenario.sections.apparatus import Entry, Setup, TrackerSettings
from flexneedle.scenario.sections.environment import ENVIRONMENTS, expand_environment
from flexneedle.scenario.sections.fields import Section, Title
from flexneedle.scenario.sections.monitor import GuardSettings, MonitorSettings
from flexneedle.scenario.sections.needle import Needle
from flexneedle.scenario.sections.settings import ControlSettings, PhantomSettings, PlanSettings, Target
from flexneedle.scenario.sections.structure import structure_problems
from flexneedle.scenario.sections.zones import AnyZone, ImageSettings, ZoneSettings
from flexneedle.scenario.sensors.kinds import AnySensor
from flexneedle.scenario.tissue.laws import AnyLayer
from flexneedle.scenario.tissue.layer import Contact

_ENVIRONMENT = "tracker.environment"
_LISTS = ("zone", "sensor")  # absent in files that list none


class Difference(NamedTuple):
    """A key as in messages, such as `tissue[0].alpha`, with its values in two scenarios, "none" if it is not set."""

    key: str
    old: Any
    new: Any


class Scenario(Section):
    """A scenario, frozen. Fields have the names and units of the file.

    Properties without a unit in their name are in mm, N, MPa, rad, s. Raises ScenarioError, one line for each problem.
    """

    name: Title
    """Title in tables and figures."""
    needle: Needle
    setup: Setup
    tissue: Annotated[tuple[AnyLayer, ...], Field(strict=False, max_length=1_000)]
    """Layers from the skin down."""
    contact: Contact = Contact()
    entry: Entry = Entry()
    target: Target = Target()
    image: ImageSettings = ImageSettings()
    zones: ZoneSettings = ZoneSettings()
    zone: Annotated[tuple[AnyZone, ...], Field(strict=False, max_length=1_000)] = ()
    """Zones to avoid."""
    plan: PlanSettings = PlanSettings()
    control: ControlSettings = ControlSettings()
    tracker: TrackerSettings = TrackerSettings()
    sensor: Annotated[tuple[AnySensor, ...], Field(strict=False, max_length=100)] = ()
    """Sensors along the needle, besides the tracker."""
    monitor: MonitorSettings = MonitorSettings()
    guard: GuardSettings = GuardSettings()
    phantom: PhantomSettings = PhantomSettings()

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ScenarioError(*describe(error, type(self))) from None

    @model_validator(mode="after")
    def _check_sections_together(self) -> Self:
        refuse(
            chain(
                geometry_problems(self.needle, self.setup),
                structure_problems(self.needle, self.setup, self.phantom.structure),
                layer_problems(self.tissue, self.needle.bevel),
                entry_problems(self.setup, self.entry),
                target_problems(self.setup, self.entry, self.target),
                zone_problems(self.zone, self.zones, self.guard),
                plan_problems(self.plan),
                monitor_problems(self.monitor, self.tracker),
                sensor_problems(self.sensor, self.tracker, self.needle, self.setup, self.target),
                grid_problems(self.setup, self.contact, self.phantom, self.tracker),
            )
        )
        return self

    @classmethod
    def from_values(cls, values: Mapping[str, Any], source: str = "") -> Self:
        """Return the scenario of nested tables.

        Args:
            values: The tables, by section.
            source: Opening of each line of an error, such as the path of a file.

        Raises:
            ScenarioError: A key is unknown or a rule is broken.
        """
        try:
            return cls.model_validate(dict(values))
        except ScenarioError as error:
            opening = f"{source}: " if source else ""
            raise ScenarioError(*(opening + line for line in error.problems)) from None

    def values(self) -> dict[str, Any]:
        """Return nested tables, with all defaults, without the keys that are not set."""
        values = self.model_dump(mode="json", exclude_none=True)
        return {name: value for name, value in values.items() if value or name not in _LISTS}

    def with_values(self, changes: Mapping[str, Any]) -> Self:
        """Return a copy with values replaced by dotted key (`tissue.0.alpha`); None removes a key.

        A modulus of a layer replaces the other one, a gauge the diameters, and both diameters the gauge.
        Raises ScenarioError if a key is unknown or the copy breaks a rule.
        """
        if not isinstance(changes, Mapping):
            raise make_refusal(
                "changes", changes, "must be values by key", 'such as {"target.depth_mm": 35.0}'
            )
        values, changes = self.values(), {spell(key): value for key, value in changes.items()}
        for key, value in (changes | dict.fromkeys(find_replaced(changes))).items():
            set_value(values, key, _expand_environment(key, value))
        for name in _LISTS:  # of keys such as sensor.0.kind, where there was none
            tables = values.get(name)
            if isinstance(tables, dict) and tables.keys() == {*range(len(tables))}:
                values[name] = [tables[number] for number in range(len(tables))]
        return self.from_values(values)

    def flat(self) -> dict[str, Any]:
        """Return all values by dotted key (`tissue.0.alpha`), in the order of the schema."""
        return flatten(self.values())

    def first_difference(self, other: "Scenario", sections: Collection[str]) -> Difference | None:
        """Return the first difference of another scenario in some sections, None if they are equal."""
        mine, theirs = (
            flatten(each.model_dump(mode="json", exclude_none=True, include={*sections}))
            for each in (self, other)
        )
        for key in mine | theirs:
            if mine.get(key) != theirs.get(key):
                return Difference(key_path(split_key(key)), mine.get(key, "none"), theirs.get(key, "none"))
        return None

    def __repr__(self) -> str:
        layers = f"{len(self.tissue)} layer{'s' if len(self.tissue) > 1 else ''}"
        guide = f"guide at {self.setup.guide_to_skin_mm:g} mm" if self.setup.has_guide else "no guide"
        target = ", ".join(f"{value:g}" for value in self.target.position[: 1 + self.setup.axes])
        needle = f"needle {self.needle.outer_diameter:g} mm"
        return f"<Scenario {self.name!r}: {needle}, {layers}, {guide}, target ({target}) mm>"

    __str__ = __repr__

    @property
    def start_base_x(self) -> float:
        """Position x of the base clamp at the start, mm."""
        return self.setup.start_tip_x - self.needle.length_mm

    @property
    def guide_home(self) -> complex:
        """Position y + iz of the guide at the start, mm; 0 without a guide."""
        guide = self.setup.guide_x
        return 0.0 if guide is None else self.entry.lateral(guide)

    @property
    def layer_tops(self) -> tuple[float, ...]:
        """Depth at which each layer begins, mm; the first is 0, the skin."""
        tops = [0.0]
        for layer in self.tissue[:-1]:
            tops.append(tops[-1] + (layer.thickness_mm or 0.0))
        return tuple(tops)

    @property
    def longest_wait(self) -> float:
        """Time (s) within which the slowest sensor along the needle sends a reading; later none is awaited."""
        return self.control.stale_after_s + max((one.longest_wait for one in self.sensor), default=0.0)

    def energy_scale(self, depth: float) -> float:
        """Return E₁, the energy (mJ) of all tissue down to `depth` (mm) displaced by 1 mm, weighted by layer."""
        ends = (*self.layer_tops[1:], max(depth, self.layer_tops[-1]))
        return sum(
            layer.energy_weight * layer.energy_per_mm(1.0) * max(0.0, min(end, depth) - top)
            for layer, top, end in zip(self.tissue, self.layer_tops, ends, strict=True)
        )


def _expand_environment(key: str, value: Any) -> Any:
    """Return the table of an environment's name, for later changes of its values; any other value unchanged."""
    known = key == _ENVIRONMENT and value in ENVIRONMENTS.names()
    return expand_environment(value) if known else value


def check_target(scenario: Scenario, depth: float, lateral: float, lateral_z: float = 0.0) -> None:
    """Raise ScenarioError if a target (x, y, z), mm, is beyond the stroke or the lateral travel."""
    place = {"depth_mm": depth, "lateral_mm": lateral, "lateral_z_mm": lateral_z}
    target = Target().model_copy(update={key: float(value) for key, value in place.items()})
    problems = [to_line(problem) for problem in target_problems(scenario.setup, scenario.entry, target)]
    if problems:
        raise ScenarioError(*problems)
