"""What the controller believes: the model's state, corrected by the tracker so that its prediction has no offset.

Readings come late. Each belongs to the move in which it was taken; the belief is corrected there, and the moves
since are predicted again (a fixed-lag filter).

In air the free end is short and stiff, and noise reads as force: there the start offset and angle of the base
are fitted (recursive least squares with a prior). In tissue the measured tip is an essential condition, and the
force that it needs, low-passed, stays as a tip load in the prediction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexneedle.ports import Command, Sample
from flexneedle.simulator import Control, Simulator, State

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Beliefs:
    """What an observer may learn: where the clamp holds the base, in air; a tip load, in tissue.

    Without the load the measured tip is released again in the prediction, as in the paper.
    """

    fits_start: bool = True
    learns_load: bool = True


@dataclass(frozen=True)
class Move:
    """What the driver did from `begun` to `ended` (s), and the good readings taken meanwhile."""

    begun: float
    ended: float
    applied: Command
    samples: tuple[Sample, ...] = ()


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is believed: `state` is that of now.

    past: the belief before the first of `moves`, those of which readings may still come; tips (k + 1, 3): believed
    tip pose at their ends, the start first; covariance (2, 2) of base y (mm) and turn (rad); innovation: that of
    the last corrected move (mm); measured: tip (x, y) seen at its end (mm), None before the first reading.
    """

    simulator: Simulator
    beliefs: Beliefs
    state: State
    past: State
    covariance: Floats
    tips: Floats
    moves: tuple[Move, ...] = ()
    innovation: tuple[float, float] = (0.0, 0.0)
    measured: tuple[float, float] | None = None

    @property
    def tip(self) -> Floats:
        """Tip pose (3,)."""
        return self.state.tip

    def tip_at(self, time: float) -> tuple[float, float]:
        """Where the tip was believed to be (mm) at `time`, each move taken as even."""
        if not self.moves:
            x, y = self.tip[:2]
            return float(x), float(y)
        times = [self.moves[0].begun, *(move.ended for move in self.moves)]
        return float(np.interp(time, times, self.tips[:, 0])), float(np.interp(time, times, self.tips[:, 1]))


def begin(simulator: Simulator, bevel: int, beliefs: Beliefs = Beliefs()) -> Estimate:  # noqa: B008 - frozen
    """Believe in a straight start, with the prior of the scenario."""
    control = simulator.scenario.control
    prior = np.diag([control.start_offset_sd_mm**2, control.start_angle_sd**2])
    state = simulator.start(bevel)
    return Estimate(simulator, beliefs, state, state, prior, state.tip[None])


def move(estimate: Estimate, applied: Command, begun: float, ended: float) -> Estimate:
    """Move the believed needle as the driver did, from `begun` to `ended` (s)."""
    state = estimate.simulator.step(estimate.state, Control.from_row(applied))
    return replace(
        estimate,
        state=state,
        tips=np.concatenate([estimate.tips, state.tip[None]]),
        moves=(*estimate.moves, Move(begun, ended, applied)),
    )


def observe(estimate: Estimate, samples: Sequence[Sample]) -> Estimate:
    """Correct the belief by good samples (newest last); a move is closed once a reading of its end is in."""
    moves = _assigned(estimate.moves, samples)
    newest = max((sample.time for sample in samples), default=-np.inf)
    at = replace(estimate, state=estimate.past, moves=moves)
    past, closed, tips = at, 0, [at.tip]
    for k, done in enumerate(moves):
        at = _followed(at, done)
        tips.append(at.tip)
        if closed == k and newest >= done.ended - 1e-9:
            past, closed = at, k + 1
    return replace(
        at, past=past.state, covariance=past.covariance, moves=moves[closed:], tips=np.array(tips[closed:])
    )


def _assigned(moves: tuple[Move, ...], samples: Sequence[Sample]) -> tuple[Move, ...]:
    """Give each sample to the move in which it was taken; one of before to the first, one of after to the last."""
    ends = np.array([done.ended for done in moves[:-1]])
    owner = np.searchsorted(ends, [sample.time - 1e-9 for sample in samples])
    return tuple(
        replace(done, samples=done.samples + tuple(s for s, k in zip(samples, owner, strict=True) if k == j))
        for j, done in enumerate(moves)
    )


def _followed(at: Estimate, done: Move) -> Estimate:
    """The belief after a move: predicted, and corrected by the mean innovation of its readings."""
    before, predicted = at.tip, at.simulator.step(at.state, Control.from_row(done.applied))
    if not done.samples:
        return replace(at, state=predicted)
    seen = np.mean([_innovation(before, predicted.tip, done, sample) for sample in done.samples], axis=0)
    measured = predicted.tip[:2] + seen
    at = replace(
        at,
        innovation=(float(seen[0]), float(seen[1])),
        measured=(float(measured[0]), float(measured[1])),
    )
    if predicted.tip[0] > 0.0:
        return replace(at, state=_held(at, predicted))
    if not at.beliefs.fits_start:
        return replace(at, state=at.simulator.assimilate(predicted, measured.tolist()).state)
    noise = at.simulator.scenario.tracker.jitter_per_axis / np.sqrt(len(done.samples))
    return _fit_start(at, predicted, float(seen[1]), float(noise))


def predicted_tip(
    before: Floats, after: Floats, begun: float, ended: float, time: float
) -> tuple[float, float]:
    """Where the model had its tip (mm) at `time` within a move, assumed even."""
    part = 1.0 if ended <= begun else min(1.0, max(0.0, (time - begun) / (ended - begun)))
    x, y = before[:2] + part * (after[:2] - before[:2])
    return float(x), float(y)


def _innovation(before: Floats, after: Floats, done: Move, sample: Sample) -> tuple[float, float]:
    if sample.x is None or sample.y is None:
        raise ValueError("an empty sample was not sorted out")
    x, y = predicted_tip(before, after, done.begun, done.ended, sample.time)
    return sample.x - x, sample.y - y


def _fit_start(at: Estimate, predicted: State, seen: float, noise: float) -> Estimate:
    """One step of recursive least squares on base y and turn; linear, since nothing but the guide touches."""
    simulator = at.simulator
    sensitivity = np.array(
        [_tip_shift(simulator, predicted, 1.0, 0.0), _tip_shift(simulator, predicted, 0.0, 1e-3) / 1e-3]
    )
    spread = at.covariance @ sensitivity
    gain = spread / (sensitivity @ spread + noise**2 + 1e-12)
    base_y, base_turn = predicted.base[1:] + gain * seen
    corrected = simulator.step(
        predicted.believing(base_y=float(base_y), base_turn=float(base_turn)), Control()
    )
    return replace(at, state=corrected, covariance=at.covariance - np.outer(gain, spread))


def _tip_shift(simulator: Simulator, state: State, base_y: float, base_turn: float) -> float:
    """Lateral shift of the tip (mm) for a shift of the base (mm, rad)."""
    _, y, turn = state.base
    moved = state.believing(base_y=float(y) + base_y, base_turn=float(turn) + base_turn)
    return float(simulator.step(moved, Control()).tip[1] - state.tip[1])


def _held(at: Estimate, predicted: State) -> State:
    """The state with its tip where it was seen, and the load that this takes, low-passed, if it is learnt."""
    held = at.simulator.assimilate(predicted, np.add(predicted.tip[:2], at.innovation).tolist()).state
    if not at.beliefs.learns_load:
        return held
    gain = at.simulator.scenario.control.load_gain
    return held.believing(tip_load=held.tip_load + gain * held.reactions.tip_force)
