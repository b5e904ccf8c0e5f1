"""The guard between loop and driver: it refuses commands that would exceed a limit of needle or tissue.

The state after the command is predicted with the model of the estimate. The guard knows nothing of planners and
controllers, and no option of an insertion switches it off. Limits: section `guard` of the scenario (decision 0021).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexneedle.estimation.axial import carry_out
from flexneedle.estimation.estimate import Estimate
from flexneedle.results import Plan, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.tissue.layer import laws_of
from flexneedle.simulator.state import State
from flexneedle.types import DB_X, Control, Floats, X

_SHARE_OF_LAW = 0.95  # of the compression at which a law ends
_SCALE_SDS = 3.0  # of the prior of the scale
_UNEVEN = 0.1  # of the advance's error: larger distances of readings from an even advance are no scale
_ROUNDING = 1e-6  # of a solve: a needle at rest beyond a limit may rest


@dataclass(frozen=True)
class Excess:
    """Distance of a quantity beyond its limit, negative within it, and both values as text."""

    beyond: float
    text: str


@dataclass(frozen=True, eq=False)
class Guard:
    """Limits of an insertion.

    Largest compression e of the tissue by law (l,), strain of the needle by bending, force of the guide (N), distance
    (mm) of the tip past the target, which is at `depth` (mm), and error of the scale of the needle's advance; jitter
    (mm) of a reading.
    """

    compression: Floats
    strain: float
    force: float
    past: float
    depth: float
    scale: float
    jitter: float

    @staticmethod
    def of(scenario: Scenario, plan: Plan) -> "Guard":
        """Return the limits of a scenario with the target of a plan."""
        settings, laws = scenario.guard, laws_of(scenario.tissue)[0]
        least = settings.least_stretch
        compression = [_SHARE_OF_LAW * law.limit if least is None else 1.0 - least for law in laws]
        force = math.inf if settings.guide_force_n is None else settings.guide_force_n
        strain, past = 1e-2 * settings.needle_strain_percent, settings.past_target_mm
        scale = _SCALE_SDS * scenario.control.axial_scale_sd
        jitter = scenario.tracker.jitter_per_axis
        return Guard(np.array(compression), strain, force, past, plan.target[0], scale, jitter)

    def refusal(self, estimate: Estimate, command: Control) -> str:
        """Return the reason to refuse a command, "" for none.

        Beyond a limit, which a reading may reveal, a command may lead back but not further.
        """
        now = estimate.state
        if abs(estimate.axial_scale - 1.0) > self.scale:
            return f"guard: {self._describe_advance(estimate)}"
        then = carry_out(estimate.simulator, now, command)
        if not then.converged:
            return f"guard: the model does not converge: residual {then.residual:.3g} mm"
        both = zip(self._excesses(now), self._excesses(then), strict=True)
        worse = (new for old, new in both if new.beyond > max(old.beyond, 0.0) + _ROUNDING)
        return next((f"guard: {excess.text}" for excess in worse), "")

    def _describe_advance(self, estimate: Estimate) -> str:
        """Return what the readings of an advance that differs from the commanded one show: a scale, or none."""
        scale, misfit = estimate.even_advance
        most = self.jitter + _UNEVEN * abs((scale - 1.0) * estimate.state.travel[DB_X])
        if misfit > most:
            return (
                f"the tracker's readings fit no even advance (off by {misfit:.2f} mm, limit {most:.2f} mm): late now "
                "and then, as on a busy computer, or the needle slips; its depth is unknown"
            )
        return (
            f"by the tracker the needle advances {scale:.3g} times as far as commanded "
            f"(limit 1 ± {self.scale:g}): check insertion axis and tracker (flexneedle rig test)"
        )

    def _excesses(self, state: State) -> Iterator[Excess]:
        yield self._compression_excess(state)
        strain = bending_strain(state)
        yield Excess(strain - self.strain, f"needle strain {1e2 * strain:.3f} % > {1e2 * self.strain:g} %")
        force = math.hypot(*state.reactions.guide_force)
        yield Excess(force - self.force, f"guide force {force:.3g} N > {self.force:.3g} N")
        past = float(state.tip[X]) - self.depth
        yield Excess(past - self.past, f"tip {format_mm(past)} past the target > {self.past:g} mm")

    def _compression_excess(self, state: State) -> Excess:
        """Return the excess of the contact that is farthest beyond the limit of its law."""
        contacts = state.contacts
        if not contacts.active.any():
            return Excess(-math.inf, "")
        stretch, least = contacts.stretch, 1.0 - self.compression[contacts.law]
        worst = int((least - stretch).argmax())
        text = f"tissue stretch {stretch[worst]:.3f} < {least[worst]:.3f}"
        return Excess(float(least[worst] - stretch[worst]), text)


def bending_strain(state: State) -> float:
    """Return the largest strain M d/2EI of the needle's surface by bending.

    Moments are largest where a force acts.
    """
    needle = state.scenario.needle
    moments = np.append(np.abs(state.mesh["moment"]), math.hypot(*state.reactions.base_moment))
    return float(moments.max() * needle.outer_diameter / (2.0 * needle.bending_stiffness))
