"""Named targets of the session, one of which is the scenario's."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count

from flexneedle.lab.page.protocol import NamedTarget, Vector
from flexneedle.lab.page.server.clients import Refusal

_MOST = 50


@dataclass(frozen=True)
class NamedTargets:
    """Targets by name.

    Attributes:
        active: Name of the scenario's target.
        others: Positions of the others (mm) by name.
        order: Names of all, in the order in which they were added.
    """

    active: str = "Target 1"
    others: Mapping[str, Vector] = field(default_factory=dict)
    order: tuple[str, ...] = ("Target 1",)

    @classmethod
    def of(cls, targets: list[NamedTarget], active: str) -> "NamedTargets":
        """Return the targets of a message. Raises Refusal for a name that occurs twice, or no active target."""
        names = tuple(one.name for one in targets)
        if len(set(names)) < len(names) or active not in names:
            raise Refusal(f"targets = {', '.join(names)}: must have different names, and {active}")
        return cls(active, {one.name: one.position for one in targets if one.name != active}, names)

    def list_all(self, position: Vector) -> list[NamedTarget]:
        """Return all targets. position: of the active one."""
        found = {**self.others, self.active: position}
        return [NamedTarget(name=name, position=found[name]) for name in self.order]

    def add(self, name: str, position: Vector) -> "NamedTargets":
        """Return the targets with a new, active one at the position of the active one. name "": the next number."""
        name = name or next(
            one for one in (f"Target {number}" for number in count(1)) if one not in self.order
        )
        if name in self.order:
            raise Refusal(f"{name}: there is already a target of this name: choose another")
        if len(self.order) >= _MOST:
            raise Refusal(f"there are {_MOST} targets, which is the limit: remove one first")
        return NamedTargets(name, {**self.others, self.active: position}, (*self.order, name))

    def choose(self, name: str, position: Vector) -> tuple["NamedTargets", Vector]:
        """Return the targets with another active one, and its position. position: of the present one."""
        self._require(name)
        found = {**self.others, self.active: position}
        goal = found.pop(name)
        return NamedTargets(name, found, self.order), goal

    def remove(self, name: str) -> "NamedTargets":
        """Return the targets without one. Raises Refusal for the active one."""
        self._require(name)
        if name == self.active:
            raise Refusal(f"{name} is the target of the scenario: choose another one first")
        others = {one: position for one, position in self.others.items() if one != name}
        return NamedTargets(self.active, others, tuple(one for one in self.order if one != name))

    def _require(self, name: str) -> None:
        if name not in self.order:
            raise Refusal(f"target = {name}: must be one of {', '.join(self.order)}")
