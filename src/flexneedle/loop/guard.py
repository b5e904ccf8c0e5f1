"""The guard between loop and driver: it refuses commands that would exceed a limit of needle or tissue.

The state after the command is predicted with the model of the estimate. The guard knows nothing of planners and
controllers, and no option of an insertion switches it off. Limits: section `guard` of the scenario (decision 0021).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from flexneedle.estimation.axial import carry_out
from flexneedle.estimation.estimate import Estimate
from flexneedle.results import Plan, format_mm
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.excess import Excess, LoadLimits
from flexneedle.simulator.state import State
from flexneedle.simulator.zones import NO_ZONES, ZoneMap, zones_of
from flexneedle.types import DB_X, Control, X

_SCALE_SDS = 3.0  # of the prior of the scale
_UNEVEN = 0.1  # of the advance's error: larger distances of readings from an even advance are no scale
_ROUNDING = 1e-6  # of a solve: a needle at rest beyond a limit may rest


@dataclass(frozen=True, eq=False)
class Guard:
    """Limits of an insertion.

    Loads of needle and tissue, distance (mm) of the tip past the target, which is at `depth` (mm), and error of the
    scale of the needle's advance; jitter (mm) of a reading; zones, and the least clearance (mm) from them.
    """

    loads: LoadLimits
    past: float
    depth: float
    scale: float
    jitter: float
    zones: ZoneMap = NO_ZONES
    buffer: float = 0.0

    @staticmethod
    def of(scenario: Scenario, plan: Plan) -> "Guard":
        """Return the limits of a scenario with the target of a plan."""
        scale = _SCALE_SDS * scenario.control.axial_scale_sd
        past, jitter = scenario.guard.past_target_mm, scenario.tracker.jitter_per_axis
        zones, buffer = zones_of(scenario), scenario.guard.zone_buffer_mm
        return Guard(LoadLimits.of(scenario), past, plan.target[0], scale, jitter, zones, buffer)

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
        yield from self.loads.excesses(state)
        past = float(state.tip[X]) - self.depth
        yield Excess(past - self.past, f"tip {format_mm(past)} past the target > {self.past:g} mm")
        if self.zones:
            yield self._intrusion(state)

    def _intrusion(self, state: State) -> Excess:
        """Return the excess of the least clearance permitted over the clearance."""
        body = state.body
        if not body.size:
            return Excess(-math.inf, "")
        found = self.zones.clearances(body)
        zone, least = int(found.min(axis=1).argmin()), float(found.min())
        text = (
            f"clearance from zone {self.zones.names[zone]} would be {format_mm(least)} < {self.buffer:g} mm"
        )
        return Excess(self.buffer - least, text, key="zone_buffer_mm")
