"""Samples of corrections of the current path: at random, and aimed at the target by guide or bevel."""

import numpy as np
from numpy.typing import NDArray

from flexneedle.control.limits import limit_roll
from flexneedle.control.path import DUE, KNOTS, Ahead
from flexneedle.types import Floats, Laterals

_STEEPEST = 0.03  # slope of the largest correction of the guide, mm per mm of the path left
_SHARE_OF_A_STEP = 0.5  # of the guide's limit in a control step, added to it: largest next to the target
_FURTHEST = 0.3  # largest move of a roll, of the path left
_WIDEST = 1.0  # largest change of an angle (rad)
_DECADES = 2.0  # over which the scales of the samples spread
_FINER_DECADES = (-2.5, -0.3)  # of the scales of the guide's changes in aimed samples
_OVERSHOOT = 1.2  # largest share of a miss that an aimed sample undoes
# The first of a dozen samples that the bevel aims, without the guide; the next one moves it, too.
_BY_BEVEL = 3
_PAIRS_NOW = 0.5  # share of pairs of rolls that begin now, over those that begin later
_LEAST_CHORD = 0.1  # motion of the bevel's direction in a pair of rolls, from which it is aimed
_SPREAD = 0.3  # of the lengths of aimed pairs, logarithmic


def propose_samples(ahead: Ahead, count: int, rng: np.random.Generator, aim: complex = 1.0) -> Floats:
    """Return samples (count, d) around the current path, which is the first, with scales over two decades.

    With a guide a quarter changes it alone, a quarter the rolls alone, a sixth adds a pair of rolls, the rest changes
    all; without one three quarters change the rolls, a half adds a pair. Where the needle rolls to any angle, a pair
    rolls it to either side of the direction `aim`, half of them now.
    """
    z = np.tile(ahead.current, (count, 1))
    k, depths = ahead.knots, ahead.depths
    kind = np.arange(count) % 12
    scale = 10.0 ** rng.uniform(-_DECADES, 0.0, (count, 2))
    guide = _widest(ahead) * scale[:, :1] * rng.standard_normal((count, k))
    rolls = _FURTHEST * ahead.left * scale[:, 1:] * rng.standard_normal((count, ahead.slots))
    if ahead.step > 0.0:
        z[:, :k] += np.where(((kind < 3) | (kind >= 8))[:, None], guide, 0.0)
    used = z[0, depths] < ahead.depth[-1]
    z[:, depths] += np.where((kind >= 3)[:, None] & used, rolls, 0.0)
    pair = np.flatnonzero((kind == 6) | (kind == 7)) if ahead.step > 0.0 else np.flatnonzero(kind % 2 == 0)
    if used.sum() <= ahead.slots - 2:
        middle = rng.uniform(ahead.depth[0], ahead.depth[-1], pair.size)
        half = 0.5 * ahead.left * 10.0 ** rng.uniform(-1.5, 0.0, pair.size)
        z[pair, depths.stop - 2], z[pair, depths.stop - 1] = middle - half, middle + half
    if not ahead.setup.half_turns:
        _propose_angles(ahead, z, scale[:, 1:], (kind >= 3)[:, None] & used, pair, aim, rng)
    z[0] = ahead.current
    return np.clip(z, *ahead.bounds)


def aim_samples(
    ahead: Ahead, z: Floats, miss: complex, lever: Floats, bend: complex, rng: np.random.Generator
) -> Floats:
    """Return samples z (N, d), the current path first, with corrections of the guide that are aimed at the target.

    miss: y + iz, mm, of the current path; lever: motion of its end (k,) by a correction at each knot, the same on each
    axis; bend: its motion, y + iz, per mm of path on which the bevel keeps its side. The miss with the rolls of a
    sample follows by the linear model. The guide's correction is random, and a second one in a random direction as
    large as undoes 0 to 1.2 of that miss. A third of the samples have only the second. In a sixth the bevel undoes the
    miss, by a pair of rolls, half of them with a random correction of the guide.
    """
    used, kind = ahead.bevel_use(z), np.arange(len(z)) % 12
    by_bevel, still = (kind == _BY_BEVEL) | (kind == _BY_BEVEL + 1), kind == _BY_BEVEL
    change, along = _vary_guide(ahead, len(z), rng)
    change[0], change[still] = 0.0, 0.0
    misses = miss + bend * (used - used[0])
    aimed, paired = add_pairs(ahead, z, by_bevel, misses + change @ lever, bend, rng)
    share = np.where(by_bevel, 0.0, rng.uniform(0.0, _OVERSHOOT, len(z)))
    undone = undo_miss(change, along, lever, share * (misses if ahead.axes == 2 else misses.real))
    undone[0], undone[by_bevel] = 0.0, 0.0
    change = np.where(paired[:, None], change, undone)
    aimed[:, : ahead.knots] = np.concatenate([change.real, change.imag], axis=1)[:, : ahead.knots]
    return np.clip(aimed, *ahead.bounds)


def add_pairs(
    ahead: Ahead,
    z: Floats,
    which: NDArray[np.bool_],
    misses: Laterals,
    bend: complex,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return samples z (N, d), of which some have a pair of rolls that undoes their miss (N,), and which do (N,).

    which: the samples (N,) that are to have one, where the slots and the direction of the bevel allow it. The first
    roll is anywhere on the path, a third of them now. Over a length w the bevel is turned by φ from its direction β,
    which moves the end by bend w β (exp(iφ) − 1): along the chord of a circle.
    """
    depths, left = ahead.depths, ahead.left
    free = int((z[0, depths] >= ahead.depth[-1]).sum())
    if free < 2 or not bend:
        return z.copy(), np.zeros_like(which)
    begin = ahead.depth[0] + left * np.maximum(0.0, rng.uniform(-_PAIRS_NOW, 1.0, len(z)))
    angle = ahead.angle_at(z, begin)
    wanted = -misses / (bend * np.exp(1j * (angle - ahead.state.roll)))
    if ahead.setup.half_turns:
        wanted = wanted.real + 0j
    towards = np.exp(1j * np.angle(wanted))
    chord = -2.0 * towards.real  # of exp(iφ) − 1
    length = np.divide(np.abs(wanted), chord, out=np.full_like(chord, np.inf), where=chord > _LEAST_CHORD)
    length *= np.exp(_SPREAD * rng.standard_normal(len(z)))
    made = which & (begin + length < ahead.depth[-1]) & (length > DUE * ahead.advance)
    pairs: Floats = z.copy()
    last = depths.stop
    pairs[made, last - 2], pairs[made, last - 1] = begin[made], (begin + length)[made]
    if not ahead.setup.half_turns:
        last = ahead.angles.stop
        turned = angle + np.angle(-(towards**2))
        pairs[made, last - 2], pairs[made, last - 1] = turned[made], angle[made]
    return pairs, made


def _vary_guide(ahead: Ahead, count: int, rng: np.random.Generator) -> tuple[Laterals, Floats]:
    """Return random changes (count, k) of the guide at the knots, y or y + iz, a third of them 0, and directions.

    Half of the changes and of the directions (count, k), which are positive, add up along the path.
    """
    shape = (count, KNOTS.size)
    noise: Laterals = rng.standard_normal(shape)
    if ahead.axes == 2:
        noise = noise + 1j * rng.standard_normal(shape)
    smooth = rng.uniform(size=(2, count, 1)) < 0.5
    scale = _widest(ahead) * 10.0 ** rng.uniform(*_FINER_DECADES, (count, 1))
    change: Laterals = scale * np.where(smooth[0], np.cumsum(noise, axis=1), noise)
    change[::3] = 0.0
    along = rng.uniform(size=shape)
    return change, np.where(smooth[1], np.cumsum(along, axis=1), along)


def undo_miss(change: Laterals, along: Floats, lever: Floats, miss: Laterals) -> Laterals:
    """Return changes (N, k) of the guide plus a share of the directions `along` (N, k), so that they undo a miss.

    miss: (N,), mm; lever: derivative (k,) of the miss. A direction without an effect on the miss is not used.
    """
    left, effect = change @ lever + miss, along @ lever
    share = np.divide(left, effect, out=np.zeros_like(left), where=effect != 0.0)
    undone: Laterals = change - share[:, None] * along
    return undone


def _widest(ahead: Ahead) -> float:
    """Return the standard deviation (mm) of the largest corrections of the guide."""
    return _STEEPEST * ahead.left + _SHARE_OF_A_STEP * ahead.step


def _propose_angles(
    ahead: Ahead,
    z: Floats,
    scale: Floats,
    changed: NDArray[np.bool_],
    pair: NDArray[np.intp],
    aim: complex,
    rng: np.random.Generator,
) -> None:
    """Change the angles of the rolls `changed` (N, s) and of the samples `pair`, half of which roll now."""
    z[:, ahead.angles] += np.where(changed, _WIDEST * scale * rng.standard_normal(changed.shape), 0.0)
    present = ahead.state.roll
    towards = present + limit_roll(ahead.setup, present, float(np.angle(aim * np.exp(-1j * present))))
    angle = rng.choice([-1.0, 1.0], pair.size) * rng.uniform(0.0, np.pi, pair.size)
    last = ahead.angles.stop
    z[pair, last - 2], z[pair, last - 1] = towards + angle, towards - angle
    z[pair[::2], ahead.depths.stop - 2] = ahead.depth[0]
