"""The session that all clients share: scenario, seed, strategy, controller."""

import json
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from hashlib import sha256
from typing import Any

from flexneedle.errors import ScenarioError, ScenarioWarning
from flexneedle.lab.page.protocol import SessionMessage, Strategy
from flexneedle.lab.page.requests import OptionsRequest, RestoreRequest, TargetsRequest
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.named_targets import NamedTargets
from flexneedle.scenario.dotted import nest, split_key
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.library import PRESETS, is_world, parse_toml
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.plausible import find_doubts
from flexneedle.scenario.sections.needle import GAUGES, Needle
from flexneedle.scenario.sections.settings import Target

_TARGET_KEYS = ("target.depth_mm", "target.lateral_mm", "target.lateral_z_mm")
_MOST_DOTS, _MOST_KEYS = 300, 1_000
"""Limits of a line and of a file, far above any scenario: the time for a dotted key grows with the square of its parts,
each unknown key starts a search for similar keys, and the server waits for both."""
_MOST_PROBLEMS = 3
"""Problems in a refusal: each key of another program's file is a problem."""
_LINE = re.compile(r"(?P<key>[^\s=:]+)(?: = .*?)?: (?P<rule>.*)")


@dataclass(frozen=True)
class PageSession:
    """A scenario with options.

    Attributes:
        origin: The scenario before the first edit.
        revision: Number of changes.
        reach_since: As in `SessionMessage`.
        notes: Warnings of the scenario's file.
    """

    name: str
    origin: Scenario
    scenario: Scenario
    controller: str = ""
    seed: int = 0
    strategy: Strategy = "manipulation"
    revision: int = 1
    reach_since: int = 1
    notes: tuple[str, ...] = field(default=())
    targets: NamedTargets = field(default_factory=NamedTargets)

    @classmethod
    def of(cls, name: str, scenario: Scenario) -> "PageSession":
        """Return a session of a scenario, with the default controller."""
        return cls(name, scenario, scenario)

    def edit_scenario(self, values: Mapping[str, Any]) -> "PageSession":
        """Return the session with changed values by key. Raises Refusal with the problems by key."""
        with _refuse_problems():
            changed = {**_cross_section(self.scenario.needle, values), **values}
            return self._change(scenario=self.scenario.with_values(changed))

    def with_preset(self, name: str) -> "PageSession":
        """Return the session with a preset or random world. Raises Refusal."""
        if not _is_preset(name):
            choices = ", ".join(PRESETS.names())
            raise Refusal(f"preset = {name}: must be one of {choices}, wide:NUMBER or world:NUMBER")
        with _refuse_problems():
            return self._begin(name, load_scenario(name), ())

    def with_file(self, name: str, text: str) -> "PageSession":
        """Return the session with the scenario of a file (TOML). Raises Refusal with the problems by key."""
        _check_size(name, text)
        try:
            values = parse_toml(text)
        except ValueError as error:
            raise Refusal(f"{name}: {error}") from None
        with warnings.catch_warnings(record=True) as caught, _refuse_problems(name):
            warnings.simplefilter("always", ScenarioWarning)
            scenario = Scenario.from_values(values)
        return self._begin(name, scenario, tuple(str(warning.message) for warning in caught))

    def with_targets(self, request: TargetsRequest) -> "PageSession":
        """Return the session with changed targets. Raises Refusal, also for a target that breaks a rule."""
        position, name = self.scenario.target.position, request.name or ""
        match request.what:
            case "add":
                return self._change(targets=self.targets.add(name, position))
            case "remove":
                return self._change(targets=self.targets.remove(name))
            case _:
                targets, goal = self.targets.choose(name, position)
                moved = self.edit_scenario(dict(zip(_TARGET_KEYS, goal, strict=True)))
                return replace(moved, targets=targets)

    @property
    def target_name(self) -> str:
        """Name of the scenario's target, "" if it is the only one."""
        return self.targets.active if self.targets.others else ""

    def with_options(self, options: OptionsRequest) -> "PageSession":
        """Return the session with other options; None leaves one unchanged."""
        chosen = options.model_dump(include={"seed", "strategy", "controller"}, exclude_none=True)
        return self._change(**chosen)

    def restore(self, request: RestoreRequest) -> "PageSession":
        """Return the session of an open page. Raises Refusal with the problems by key."""
        with _refuse_problems(request.name):
            scenario = Scenario.from_values(nest(request.values))
            if _is_preset(request.name):
                origin = load_scenario(request.name)
            else:
                origin = self.origin if request.name == self.name else scenario
        options = request.model_dump(include={"seed", "strategy", "controller"})
        targets = NamedTargets.of(request.targets, request.target)
        return replace(self._begin(request.name, origin, ()), scenario=scenario, targets=targets, **options)

    def has_content_of(self, other: "PageSession") -> bool:
        """Return whether all but the revisions is equal."""
        return (
            replace(self, revision=other.revision, reach_since=other.reach_since, notes=other.notes) == other
        )

    def digest(self, rig: str | None) -> str:
        """Return a text that is equal for the same session and rig."""
        content = [self.name, self.scenario.values(), self.seed, self.strategy, self.controller, rig]
        return sha256(json.dumps(content).encode()).hexdigest()

    def resume(self, other: "PageSession") -> "PageSession":
        """Return the session with the content of another, as its next revision."""
        names = [one.name for one in fields(self) if one.name not in ("revision", "reach_since")]
        return self._change(**{name: getattr(other, name) for name in names})

    def describe(self) -> SessionMessage:
        """Return the message about the session, without its history."""
        values, before = self.scenario.flat(), self.origin.flat()
        return SessionMessage(
            revision=self.revision,
            reach_since=self.reach_since,
            name=self.name,
            values=values,
            changed=[key for key in before | values if before.get(key) != values.get(key)],
            doubts=[*self.notes, *find_doubts(self.scenario), *self.scenario.image.doubt_lines],
            seed=self.seed,
            strategy=self.strategy,
            controller=self.controller,
            targets=self.targets.list_all(self.scenario.target.position),
            target=self.targets.active,
        )

    def _change(self, **changes: Any) -> "PageSession":
        after = replace(self, revision=self.revision + 1, **changes)
        same = _reach_inputs(after) == _reach_inputs(self)
        return after if same else replace(after, reach_since=after.revision)

    def _begin(self, name: str, scenario: Scenario, notes: tuple[str, ...]) -> "PageSession":
        revision = self.revision + 1
        begun = replace(
            self, name=name, origin=scenario, scenario=scenario, notes=notes, targets=NamedTargets()
        )
        return replace(begun, revision=revision, reach_since=revision)


def _is_preset(name: str) -> bool:
    """Return whether a name is one of a preset or a random world."""
    return name in PRESETS.names() or is_world(name)


def _cross_section(needle: Needle, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values that complete an edit of a needle's cross-section: gauge and diameters replace each other."""
    gauge, diameters = "needle.gauge", ("needle.outer_diameter_mm", "needle.inner_diameter_mm")
    if values.get(gauge) is not None:
        return dict.fromkeys(diameters)
    given = any(values.get(key) is not None for key in diameters)
    if needle.gauge is None or not (given or gauge in values):
        return {}
    return {gauge: None, **dict(zip(diameters, GAUGES[needle.gauge], strict=True))}


def _reach_inputs(session: PageSession) -> tuple[Scenario, int, Strategy]:
    """Return the inputs of a reach: all settings but the target (`worker/reach_job.py` has its targets)."""
    return session.scenario.model_copy(update={"target": Target()}), session.seed, session.strategy


def _check_size(name: str, text: str) -> None:
    """Raise Refusal for a file that would take long to read and is no scenario."""
    lines = [line for line in text.split("\n") if not line.lstrip().startswith("#")]
    dots = max(line.count(".") for line in lines) if lines else 0
    keys = sum(line.count("=") + line.lstrip().startswith("[") for line in lines)
    for count, most, what in ((dots, _MOST_DOTS, "dots in a line"), (keys, _MOST_KEYS, "keys and tables")):
        if count > most:
            raise Refusal(f"{name}: {count} {what}: no scenario has more than {most}")


@contextmanager
def _refuse_problems(name: str = "") -> Iterator[None]:
    """Convert a ScenarioError to a Refusal. name: of the file."""
    try:
        yield
    except ScenarioError as error:
        problems = dict(_split_problem(line) for line in reversed(error.problems))
        reason = "; ".join(error.problems[:_MOST_PROBLEMS])
        if (more := len(error.problems) - _MOST_PROBLEMS) > 0:
            reason += f"; and {more} more"
        raise Refusal(f"{name}: {reason}" if name else reason, problems) from None


def _split_problem(line: str) -> tuple[str, str]:
    """Return dotted key and rule of a problem's line; the key is "" in a line without one."""
    found = _LINE.fullmatch(line)
    return (".".join(map(str, split_key(found["key"]))), found["rule"]) if found else ("", line)
