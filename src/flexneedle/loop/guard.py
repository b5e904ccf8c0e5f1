"""The guard between loop and driver: no command is carried out after which needle or tissue would exceed a limit.

The state after the command is predicted with the model of the estimate. The guard knows nothing of planners and
controllers, and no option of an insertion switches it off. Limits: section `guard` of the scenario (decision 0021).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexneedle.estimation.estimate import Estimate, after
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.state import State
from flexneedle.types import Control, Floats, Plan, X

_SHARE_OF_LAW = 0.95  # of the compression at which a law ends
_ROUNDING = 1e-6  # of a solve: a needle at rest beyond a limit may rest


@dataclass(frozen=True)
class Excess:
    """How far a quantity of a state is beyond its limit, below 0 within it, and both as text."""

    beyond: float
    text: str


@dataclass(frozen=True, eq=False)
class Guard:
    """Largest compression e of the tissue by law (l,), strain of the needle by bending, force of the guide (N), and
    distance (mm) of the tip past the target, at `depth` (mm).
    """

    compression: Floats
    strain: float
    force: float
    past: float
    depth: float

    @staticmethod
    def of(scenario: Scenario, plan: Plan) -> "Guard":
        """The limits of a scenario, and the target of a plan."""
        settings, laws = scenario.guard, laws_of(scenario.tissue)[0]
        least = settings.least_stretch
        compression = [_SHARE_OF_LAW * law.limit if least is None else 1.0 - least for law in laws]
        force = math.inf if settings.guide_force_n is None else settings.guide_force_n
        strain, past = 1e-2 * settings.needle_strain_percent, settings.past_target_mm
        return Guard(np.array(compression), strain, force, past, plan.target[0])

    def refusal(self, estimate: Estimate, command: Control) -> str:
        """Why a command must not be carried out, or "".

        Beyond a limit, as an estimate may come to be by a reading, a command may lead back but not on.
        """
        now = estimate.state
        then = after(estimate.simulator, now, command)
        if not then.converged:
            return f"guard: the model does not converge: residual {then.residual:.3g} mm"
        both = zip(self._excesses(now), self._excesses(then), strict=True)
        worse = (new for old, new in both if new.beyond > max(old.beyond, 0.0) + _ROUNDING)
        return next((f"guard: {excess.text}" for excess in worse), "")

    def _excesses(self, state: State) -> Iterator[Excess]:
        yield self._compressed(state)
        strain = bending_strain(state)
        yield Excess(strain - self.strain, f"needle strain {1e2 * strain:.3f} % > {1e2 * self.strain:g} %")
        force = math.hypot(*state.reactions.guide_force)
        yield Excess(force - self.force, f"guide force {force:.3g} N > {self.force:.3g} N")
        past = float(state.tip[X]) - self.depth
        yield Excess(past - self.past, f"tip {past:.2f} mm past the target > {self.past:g} mm")

    def _compressed(self, state: State) -> Excess:
        """Of the contact that is most beyond the limit of its law."""
        contacts = state.contacts
        if not contacts.active.any():
            return Excess(-math.inf, "")
        stretch, least = contacts.stretch, 1.0 - self.compression[contacts.law]
        worst = int((least - stretch).argmax())
        text = f"tissue stretch {stretch[worst]:.3f} < {least[worst]:.3f}"
        return Excess(float(least[worst] - stretch[worst]), text)


def bending_strain(state: State) -> float:
    """Largest strain M d/2EI of the needle's surface by bending; moments are largest where a force acts."""
    needle = state.scenario.needle
    moments = np.append(np.abs(state.mesh["moment"]), math.hypot(*state.reactions.base_moment))
    return float(moments.max() * needle.outer_diameter / (2.0 * needle.bending_stiffness))
