"""The terms of all costs: each with its function, its unit, and its weight in the settings of every user.

The users are the planner (`plan`) and two controllers (`ce_mpc`, `adaptive_mpc`); `broyden-mpc` solves a least-squares
problem instead. A cost is the weighted sum of its terms, in the order of this file. A term is added by one decorated
function:

    @cost_term("mJ", at_end=("energy",), plan=Weight("end energy", "end_energy_weight_mm", "mm", 0.05, "Weight of …"))
    def energy_at_end(trajectories):
        return trajectories.energy[:, -1]

The key of each weight then is a setting of its user: in scenario files, `flexneedle scenario schema`, the page's form
and docs/reference/scenario.md. Reports list the term by its name. It names the outputs of a rollout that it takes, of
each step (`outputs`) or of the last (`at_end`); others are not computed. A function takes `Trajectories` and returns
one number for each sequence, (N,). It gets its further arguments by name from the values that the user provides: always
`target` (x, y, z in mm); the others are those that the functions below take.

A term outside of the package is a function of `trajectories`, or of `trajectories` and `target`. It is listed in a
scenario with its weight, as `[[plan.terms]]`, `[[control.ce_mpc.terms]]` or
`[[control.adaptive_mpc.terms]]`: `term = "module:NAME"`, `weight = 0.5`.

The terms with sums over steps are from the paper (eq. 13) and depend on the length of a step.
"""

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from flexneedle.costs.normal import moments_above_zero
from flexneedle.costs.weighted_sum import Cost, Term, Trajectories, Weight, cost_term
from flexneedle.types import DB_X, DG_Y, PSI, ROLL, SPIN, THETA, Floats, Point, X, Y, across

PLAN, CE_MPC, ADAPTIVE_MPC = Cost("plan"), Cost("ce_mpc"), Cost("adaptive_mpc")

Complexes = NDArray[np.complex128]
_PLAN_PRECISION_MM = 0.1  # miss of a plan above which its square costs more than the miss itself
ENERGIES = ("end energy", "mean energy", "peak energy")
"""Terms whose weights are per E₁, the energy of all tissue down to the target displaced by 1 mm."""
_ZONES = {"zones", "clearance", "compression"}  # terms of zones to avoid
SHARE_OF_LIMIT = 0.8
"""Share of a limit of the guard above which a load is charged."""
_AT_LIMIT = 0.002  # share of a limit
_COMPRESSION = 0.3  # of tissue, in detours
LITTLE_CLEARANCE = 0.3
"""Cost (mm) per mm of clearance that is missing."""


def per_energy(weights: Mapping[str, float], scale: float) -> dict[str, float]:
    """Return weights by the names of terms with the weights of energies divided by a scale (mJ); 0 if it is 0."""
    factors = dict.fromkeys(ENERGIES, 1.0 / scale if scale > 0.0 else 0.0)
    return {name: weight * factors.get(name, 1.0) for name, weight in weights.items()}


def drop_zones(terms: Iterable[Term]) -> tuple[Term, ...]:
    """Return terms without those for zones to avoid."""
    return tuple(term for term in terms if term.name not in _ZONES)


def past_target(tips: Floats, target: Point) -> Complexes:
    """Return the lateral miss y + iz (N,), mm, of the line from the last of poses (N, m, 5), at the target's depth."""
    end = tips[:, -1]
    slope = np.tan(end[:, THETA]) + 1j * np.tan(end[:, PSI])
    vector: Complexes = across(end, Y) + slope * (target[0] - end[:, X]) - complex(*target[1:])
    return vector


@cost_term("mm", plan=Weight("miss"), adaptive_mpc=Weight("miss"))
def miss(trajectories: Trajectories, target: Point, precision: float = _PLAN_PRECISION_MM) -> Floats:
    """Return the lateral distance d from the target at its depth as |d| + d²/s (mm), s the `precision` (mm)."""
    return charge_miss(np.abs(past_target(trajectories.tips, target)), precision)


def charge_miss(distance: Floats, precision: float = _PLAN_PRECISION_MM) -> Floats:
    """Return the cost (mm) of distances (mm) of ends from the target."""
    return distance + distance**2 / precision


@cost_term(
    "mJ",
    at_end=("energy",),
    plan=Weight(
        "end energy", "end_energy_weight_mm", "mm", 0.05,
        "Weight of the tissue energy at the target, relative to all tissue down to the target displaced by 1 mm.",
    ),
    adaptive_mpc=Weight(
        "end energy", "end_energy_weight_mm", "mm", 2.0,
        "As `plan.end_energy_weight_mm`.",
    ),
)  # fmt: skip
def energy_at_end(trajectories: Trajectories) -> Floats:
    """Return the strain energy of the tissue after the last step (mJ)."""
    return trajectories.energy[:, -1]


@cost_term(
    "mm²",
    outputs=("deflection",),
    plan=Weight(
        "deflection", "bend_weight", "–", 0.16,
        "Weight of the needle's mean square deflection, relative to the target's depth.",
    ),
)  # fmt: skip
def deflection(trajectories: Trajectories) -> Floats:
    """Return the mean square deflection of the needle (mm²), averaged over the advance in the tissue (paper eq. 10)."""
    return _mean_in_tissue(trajectories, trajectories.deflection)


@cost_term(
    "mJ",
    outputs=("energy",),
    plan=Weight(
        "mean energy", "mean_energy_weight_mm", "mm", 0.1,
        "`end_energy_weight_mm` for the energy averaged over the advance in the tissue.",
    ),
    adaptive_mpc=Weight(
        "mean energy", "mean_energy_weight_mm", "mm", 0.4,
        "`end_energy_weight_mm` for the energy averaged over the path ahead.",
    ),
)  # fmt: skip
def mean_energy(trajectories: Trajectories) -> Floats:
    """Return the strain energy of the tissue (mJ), averaged over the advance in the tissue."""
    return _mean_in_tissue(trajectories, trajectories.energy)


@cost_term(
    "mJ",
    outputs=("energy",),
    plan=Weight(
        "peak energy", "peak_energy_weight_mm", "mm", 0.1,
        "`end_energy_weight_mm` for the largest energy of all steps.",
    ),
    adaptive_mpc=Weight(
        "peak energy", "peak_energy_weight_mm", "mm", 1.0,
        "`end_energy_weight_mm` for the largest energy of the path ahead.",
        "larger to spare the tissue at the expense of accuracy.",
    ),
)  # fmt: skip
def peak_energy(trajectories: Trajectories) -> Floats:
    """Return the largest strain energy of the tissue after a step (mJ)."""
    peak: Floats = trajectories.energy.max(axis=1)
    return peak


@cost_term(
    "1",
    outputs=("strain", "stretch"),
    plan=Weight(
        "limits", "limit_weight_mm", "mm", 100.0,
        "Weight of the needle's strain, the tissue's compression and the guide's force beyond 80 % of their limits in "
        "`[guard]`, relative to these 80 %; it rises steeply towards the limits.",
    ),
    adaptive_mpc=Weight(
        "limits", "limit_weight_mm", "mm", 100.0,
        "As `plan.limit_weight_mm`.",
    ),
)  # fmt: skip
def load_excess(trajectories: Trajectories, strain: float, compression: float) -> Floats:
    """Return the excesses of the needle's strain and the tissue's compression over 80 % of their limits, summed.

    Of each, the largest share r of all steps counts, as max(0, (r / 0.8 − 1) 0.2 / (1 − r)).
    """
    return _excess(trajectories.strain / strain) + _excess((1.0 - trajectories.stretch) / compression)


@cost_term("1", outputs=("loads",), plan=Weight("guide force"), adaptive_mpc=Weight("guide force"))
def guide_force_excess(trajectories: Trajectories, force: float) -> Floats:
    """Return the excess of the guide's force over its limit (N), as `load_excess`."""
    return _excess(np.hypot(trajectories.loads[:, :, 4], trajectories.loads[:, :, 5]) / force)


@cost_term(
    "mm",
    outputs=("clearance",),
    plan=Weight(
        "zones", "zone_weight", "–", 60.0,
        "Weight of the distance by which the needle enters the margin of a zone to avoid.",
    ),
    adaptive_mpc=Weight(
        "zones", "zone_weight", "–", 60.0,
        "As `plan.zone_weight`.",
    ),
    ce_mpc=Weight(
        "zones", "zone_weight_mm", "mm", 60.0,
        "Weight of the distance by which the needle enters the margin of a zone to avoid, in mm² per mm.",
    ),
)  # fmt: skip
def intrusion(trajectories: Trajectories, clear: float, soft: float = 0.0) -> Floats:
    """Return by how much the needle enters zones (mm), whose margin is `clear` (mm).

    It is i²/(i + `soft`), i the largest intrusion (m − c)⁺ of all steps into the margin m at the clearance c and a
    tenth of the mean; in a zone, the depth counts again, 1.5 times.
    """
    inside = np.maximum(clear - trajectories.clearance, 0.0)
    touched = np.maximum(-trajectories.clearance, 0.0)
    size = inside.max(axis=1) + 0.1 * inside.mean(axis=1)
    total: Floats = size**2 / np.maximum(size + soft, np.finfo(float).tiny) + 1.5 * touched.max(axis=1)
    return total


@cost_term("mm", outputs=("clearance",), plan=Weight("clearance", default=LITTLE_CLEARANCE))
def little_clearance(trajectories: Trajectories, wanted: float) -> Floats:
    """Return by how much the clearance is less than `wanted` (mm): room for the corrections in an insertion."""
    missing: Floats = np.maximum(wanted - trajectories.clearance.min(axis=1), 0.0)
    return missing


@cost_term("1", outputs=("stretch",), plan=Weight("compression", default=100.0))
def detour_compression(trajectories: Trajectories) -> Floats:
    """Return the largest compression of the tissue beyond 0.3, for detours around zones.

    Tissue that the needle pushes sideways moves zones in it; they are assumed to be fixed.
    """
    excess: Floats = np.maximum(1.0 - trajectories.stretch.min(axis=1) - _COMPRESSION, 0.0)
    return excess


@cost_term(
    "mm",
    adaptive_mpc=Weight(
        "travel", "travel_weight", "–", 0.12,
        "Weight of the guide's travel in the tissue: it moves only where that lowers the rest of the cost by more.",
        "larger for less guide motion; the bevel then rolls more often.",
    ),
)  # fmt: skip
def guide_travel(trajectories: Trajectories) -> Floats:
    """Return the length (mm) of the guide's path in the steps that end with the tip in the tissue."""
    travel: Floats = (np.sqrt(_guide_squares(trajectories)) * (trajectories.tips[:, :, X] > 0.0)).sum(axis=1)
    return travel


@cost_term(
    "1",
    plan=Weight(
        "guide", "slope_weight", "–", 0.05,
        "Weight of the mean square slope of the guide's path, times the target's depth.",
    ),
    adaptive_mpc=Weight(
        "slope", "slope_weight_mm", "mm", 0.1,
        "Weight of the mean square slope of the guide's path, times the remaining share of the path.",
        "larger for less guide motion and later corrections.",
    ),
)  # fmt: skip
def guide_slope(trajectories: Trajectories) -> Floats:
    """Return the mean square slope of the guide's path over the travel of the base: ∫(dg/db_x)² db_x / ∫db_x."""
    advance = trajectories.controls[:, :, DB_X]
    squares = np.divide(
        _guide_squares(trajectories), advance, out=np.zeros_like(advance), where=advance > 0.0
    )
    slope: Floats = squares.sum(axis=1) / np.maximum(advance.sum(axis=1), np.finfo(float).tiny)
    return slope


@cost_term(
    "1",
    plan=Weight(
        "rolls", "roll_weight_mm", "mm", 0.015,
        "Cost of a roll of the bevel.",
    ),
    adaptive_mpc=Weight(
        "rolls", "roll_weight_mm", "mm", 0.03,
        "Cost of a roll of the bevel.",
    ),
)  # fmt: skip
def flips(trajectories: Trajectories, first: int = 0) -> Floats:
    """Return the number of flips of the bevel from step `first` on, by their angle: each half turn counts as one."""
    count: Floats = _half_turns(trajectories)[:, first:].sum(axis=1)
    return count


@cost_term(
    "1",
    adaptive_mpc=Weight(
        "late", "late_roll_weight", "–", 1.0,
        "Weight of the standard deviation of the tip's motion in a roll just before the target.",
        "larger if late rolls move the tip, as with a bent needle.",
    ),
)  # fmt: skip
def late_rolls(trajectories: Trajectories, depth: float, length: float) -> Floats:
    """Return the sum of e^(−d/length) over the rolls, d the distance (mm) of the tip from the depth (mm)."""
    before = trajectories.tips[:, :, X] - trajectories.controls[:, :, DB_X]
    near = np.exp(np.minimum(0.0, before - depth) / length)
    sum_: Floats = (near * _half_turns(trajectories)).sum(axis=1)
    return sum_


@cost_term(
    "mm",
    adaptive_mpc=Weight(
        "reach", "unguided_reach_weight", "–", 100.0,
        "Weight of the expected distance of the target from the bevel's reach, on axes where the guide may not move.",
        "large: the bevel alone cannot regain lost reach.",
    ),
)  # fmt: skip
def out_of_reach(trajectories: Trajectories, expected: Floats, angle: float = 0.0) -> Floats:
    """Return the expected distance (mm) of the target from the bevel's reach after the first step.

    expected (2,): if the roll before that step turns the bevel by `angle` (rad), and if it turns it the other way.
    """
    away = 0.5 - 0.5 * np.cos(trajectories.controls[:, 0, ROLL] - angle)
    value: Floats = (1.0 - away) * expected[0] + away * expected[1]
    return value


@cost_term("mm", adaptive_mpc=Weight("reserve"))
def lost_reserve(
    trajectories: Trajectories,
    begins: Floats,
    sds: Floats,
    prices: Floats,
    reach: float,
    precision: float,
    *,
    any_angle: bool,
) -> Floats:
    """Return the expected cost, p e + (p e)²/s, of the miss e that the bevel alone cannot correct, at the worst depth.

    begins (b,): depths (mm), below which the end will prove to be off by normal distances with the standard deviations
    `sds` (b,), mm; prices (b,): p there; reach: lateral motion of the end, mm per mm of path on which the bevel keeps
    its side. On the path from a depth on, of length L, the bevel moves the end by u, |u| ≤ L reach; L reach − |u| is
    left.
    """
    advance = trajectories.controls[:, :, DB_X]
    turns = trajectories.controls[:, :, ROLL] + trajectories.controls[:, :, SPIN]
    bevel = np.exp(1j * np.cumsum(turns, axis=1))
    after = reach * np.clip(trajectories.tips[:, :, X] - begins[:, None, None], 0.0, advance)
    used, most = (after * bevel).sum(axis=2), after.sum(axis=2)
    sides = np.stack([np.abs(used)] if any_angle else [used.real, -used.real])
    first, second = moments_above_zero(sides - most, sds[:, None])
    price = prices[:, None]
    expected = (price * first + price**2 * second / precision).sum(axis=0)
    worst: Floats = expected.max(axis=0, initial=0.0)
    return worst


@cost_term("mm²", ce_mpc=Weight("deviation"))
def deviation(trajectories: Trajectories, reference: Floats, orientation: float) -> Floats:
    """Return the squared deviation (mm²) from poses (m, 5), summed over the steps (paper eq. 13).

    orientation: weight of the slopes, as the distance (mm) that is equivalent to 1 rad.
    """
    off = trajectories.tips - reference
    off[:, :, THETA:] *= orientation
    total: Floats = (off**2).sum(axis=(1, 2))
    return total


@cost_term(
    "mm²",
    ce_mpc=Weight(
        "guide", "guide_weight", "–", 0.075,
        "Weight of the squared difference (mm²) between a guide step and the plan.",
    ),
)  # fmt: skip
def guide_departure(trajectories: Trajectories, nominal: Floats) -> Floats:
    """Return the squared differences (mm²) of the guide steps from `nominal` (m, 2), summed over the steps."""
    off = trajectories.controls[:, :, DG_Y : DG_Y + 2] - nominal
    total: Floats = (off**2).sum(axis=(1, 2))
    return total


@cost_term(
    "mJ",
    outputs=("energy",),
    ce_mpc=Weight(
        "energy", "energy_weight_per_mj", "1/mJ", 2.74,
        "Weight of the tissue's strain energy after each step of the horizon, in mm² per mJ.",
        "larger to spare the tissue at the expense of accuracy.",
    ),
)  # fmt: skip
def energy_of_steps(trajectories: Trajectories) -> Floats:
    """Return the strain energy of the tissue, summed over the steps (mJ)."""
    total: Floats = trajectories.energy.sum(axis=1)
    return total


def _mean_in_tissue(trajectories: Trajectories, values: Floats) -> Floats:
    """Return values of the steps (N, m), averaged over the advance in the tissue."""
    share = np.where(trajectories.inside, trajectories.controls[:, :, DB_X], 0.0)
    mean: Floats = (values * share).sum(axis=1) / np.maximum(share.sum(axis=1), np.finfo(float).tiny)
    return mean


def _excess(shares: Floats) -> Floats:
    """Return max(0, (r / 0.8 − 1) 0.2 / (1 − r)) of the largest share r of a limit (N, m) of each sequence.

    So no gain outweighs a load at its limit, where 1 − r is `_AT_LIMIT` or less.
    """
    share = shares.max(axis=1)
    left = np.maximum(1.0 - share, _AT_LIMIT) / (1.0 - SHARE_OF_LIMIT)
    excess: Floats = np.maximum(share / SHARE_OF_LIMIT - 1.0, 0.0) / left
    return excess


def _guide_squares(trajectories: Trajectories) -> Floats:
    squares: Floats = (trajectories.controls[:, :, DG_Y : DG_Y + 2] ** 2).sum(axis=2)
    return squares


def _half_turns(trajectories: Trajectories) -> Floats:
    angles = np.abs(trajectories.controls[:, :, ROLL]) + np.abs(trajectories.controls[:, :, SPIN])
    turns: Floats = angles / np.pi
    return turns
