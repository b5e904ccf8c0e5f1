"""The session that all clients share: scenario, seed, strategy, controller."""

import re
import tomllib
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from flexneedle.errors import ScenarioError, ScenarioWarning, make_printable
from flexneedle.lab.page.messages import Options, Strategy
from flexneedle.lab.page.messages import Session as SessionNews
from flexneedle.lab.page.server.refusal import Refusal
from flexneedle.scenario.dotted import split_key
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.plausible import doubts
from flexneedle.scenario.preset import PRESETS, WORLD
from flexneedle.scenario.sections.needle import GAUGES, Needle
from flexneedle.scenario.sections.settings import Target

_MOST_DOTS, _MOST_KEYS = 300, 1_000
"""Of a line of a file, and of a file, far more than any scenario has: a dotted key takes time with the square of its
parts, and each unknown key a search for what was meant, while the server does nothing else."""
_MOST_PROBLEMS = 3
"""In words; a file of another program has one with each of its keys."""
_LINE = re.compile(r"(?P<key>[^\s=:]+)(?: = .*?)?: (?P<rule>.*)")


@dataclass(frozen=True)
class Session:
    """A scenario with options. origin: that it began with; notes: warnings of its file; revision: number of changes.

    reach_since: as in its news.
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

    @classmethod
    def of(cls, name: str, scenario: Scenario) -> "Session":
        """A new session of a scenario, with the default controller."""
        return cls(name, scenario, scenario)

    def edited(self, values: Mapping[str, Any]) -> "Session":
        """The session with values of the scenario changed by key. Raises Refusal with the problems by key."""
        with _refused():
            changed = {**_cross_section(self.scenario.needle, values), **values}
            return self._changed(scenario=self.scenario.with_values(changed))

    def with_preset(self, name: str) -> "Session":
        """The session with a scenario of the package. Raises Refusal."""
        if name not in PRESETS.names() and not name.startswith(WORLD):
            choices = ", ".join(PRESETS.names())
            raise Refusal(f"preset = {name}: must be one of {choices}, or {WORLD}NUMBER")
        with _refused():
            return self._begun(name, load_scenario(name), ())

    def with_file(self, name: str, text: str) -> "Session":
        """The session with the scenario of a file's text (TOML). Raises Refusal with the problems by key."""
        _check_size(name, text)
        try:
            values = tomllib.loads(text)
        except RecursionError:
            raise Refusal(f"{name}: not TOML: nested too deeply") from None
        except ValueError as error:
            raise Refusal(f"{name}: not TOML: {make_printable(str(error))}") from None
        with warnings.catch_warnings(record=True) as caught, _refused(name):
            warnings.simplefilter("always", ScenarioWarning)
            scenario = Scenario.from_values(values)
        return self._begun(name, scenario, tuple(str(warning.message) for warning in caught))

    def with_options(self, options: Options) -> "Session":
        """The session with the options that are set."""
        chosen = options.model_dump(include={"seed", "strategy", "controller"}, exclude_none=True)
        return self._changed(**chosen)

    def news(self) -> SessionNews:
        """The session as clients get it."""
        values, before = self.scenario.flat(), self.origin.flat()
        return SessionNews(
            revision=self.revision,
            reach_since=self.reach_since,
            name=self.name,
            values=values,
            changed=[key for key in before | values if before.get(key) != values.get(key)],
            doubts=[*self.notes, *doubts(self.scenario)],
            seed=self.seed,
            strategy=self.strategy,
            controller=self.controller,
        )

    def _changed(self, **changes: Any) -> "Session":
        after = replace(self, revision=self.revision + 1, **changes)
        same = _of_the_reach(after) == _of_the_reach(self)
        return after if same else replace(after, reach_since=after.revision)

    def _begun(self, name: str, scenario: Scenario, notes: tuple[str, ...]) -> "Session":
        revision = self.revision + 1
        begun = replace(self, name=name, origin=scenario, scenario=scenario, notes=notes)
        return replace(begun, revision=revision, reach_since=revision)


def _cross_section(needle: Needle, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by key that go with an edit of a needle's cross-section: gauge and diameters take each other's place."""
    gauge, diameters = "needle.gauge", ("needle.outer_diameter_mm", "needle.inner_diameter_mm")
    if values.get(gauge) is not None:
        return dict.fromkeys(diameters)
    given = any(values.get(key) is not None for key in diameters)
    if needle.gauge is None or not (given or gauge in values):
        return {}
    return {gauge: None, **dict(zip(diameters, GAUGES[needle.gauge], strict=True))}


def _of_the_reach(session: Session) -> tuple[Scenario, int, Strategy]:
    """What a reach depends on, and some settings besides: its targets are its own (`page/worker/reach.py`)."""
    return session.scenario.model_copy(update={"target": Target()}), session.seed, session.strategy


def _check_size(name: str, text: str) -> None:
    """Raise Refusal for a file that would take long to be read and is no scenario."""
    lines = [line for line in text.split("\n") if not line.lstrip().startswith("#")]
    dots = max(line.count(".") for line in lines) if lines else 0
    keys = sum(line.count("=") + line.lstrip().startswith("[") for line in lines)
    for count, most, what in ((dots, _MOST_DOTS, "dots in a line"), (keys, _MOST_KEYS, "keys and tables")):
        if count > most:
            raise Refusal(f"{name}: {count} {what}: no scenario has more than {most}")


@contextmanager
def _refused(name: str = "") -> Iterator[None]:
    """name: of the file that is read."""
    try:
        yield
    except ScenarioError as error:
        problems = dict(_by_key(line) for line in reversed(error.problems))
        reason = "; ".join(error.problems[:_MOST_PROBLEMS])
        if (more := len(error.problems) - _MOST_PROBLEMS) > 0:
            reason += f"; and {more} more"
        raise Refusal(f"{name}: {reason}" if name else reason, problems) from None


def _by_key(line: str) -> tuple[str, str]:
    """Dotted key and rule of a problem's line; the key of a line that has none is ""."""
    found = _LINE.fullmatch(line)
    return (".".join(map(str, split_key(found["key"]))), found["rule"]) if found else ("", line)
