"""Deviations of a recorded path from the model's, as a Gaussian process along the insertion (docs/theory.md, 13).

On an axis the deviation at step i is (e, ξ): distance (mm) and heading (rad). Between two steps dx apart

    e ← e + ξ dx + a,    ξ ← ξ + b,

with independent disturbances (a, b) in each interval. Their variances are estimated, of

    heading     a random walk of the heading, per mm of advance
    lateral     a random walk across the path, per mm of advance
    turn        an error of the heading in proportion to the turn v that the model predicts
    response    an error in proportion to the lateral motion and the turn (u, v) that the model predicts beyond a
                straight continuation, such as by a motion of the guide
    shift       a lateral error in proportion to the predicted turn

The insertion as a whole also has errors of the curvature of the path (curvature) and in proportion to all that the
model predicts (gain). Readings have independent errors of position and of slope (noise).

Disturbances are heavy-tailed: each interval has a factor on its variances, a scale mixture for Student's t with `TAIL`
degrees of freedom, whose expectation follows from the data (West 1984, doi:10.1111/j.2517-6161.1984.tb01313.x).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize

from flexneedle.types import Flags, Floats

KINDS = ("heading", "lateral", "turn", "response", "shift", "curvature", "gain", "position", "slope")
"""Kinds of errors, in the order of their standard deviations: rad/√mm, mm/√mm, 1, 1, mm, 1/mm, 1, mm, rad."""
GAIN_KINDS = (5, 6)
"""Kinds of errors that an insertion has as a whole."""
_INTERVALS = 5  # kinds with a factor for each interval
_FIRST = np.array([8e-4, 0.03, 0.2, 0.3, 8.0, 2e-5, 0.1, 0.03, 3e-4])
_BOUNDS = np.array(
    [
        (1e-5, 0.1),
        (1e-4, 1.0),
        (1e-3, 3.0),
        (1e-3, 3.0),
        (1e-2, 100.0),
        (1e-6, 1e-3),
        (1e-3, 2.0),
        (5e-3, 3.0),
        (5e-5, 0.1),
    ]
)
_START = np.array([5.0, 0.1])  # standard deviation of e (mm) and ξ (rad) at the first step
TAIL = 4.0
"""Degrees of freedom of the disturbances."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations (9,) of the errors, by `KINDS`."""

    sd: Floats

    @staticmethod
    def first() -> "Noise":
        """Return the values at the start of an estimation."""
        return Noise(_FIRST)

    def without(self, kinds: Sequence[int]) -> "Noise":
        """Return the same without some kinds of errors."""
        sd = self.sd.copy()
        sd[[*kinds]] = 0.0
        return Noise(sd)


@dataclass(frozen=True, eq=False)
class Deviations:
    """Errors of a path on an axis: k steps at depths (k,), about the model's positions and slopes (k,) there.

    moved (k,): whether guide, base or roll moved since the step before.
    """

    depth: Floats
    position: Floats
    slope: Floats
    moved: Flags

    @cached_property
    def advance(self) -> Floats:
        """Advance (k,) to each step, at least a micrometre; 0 to the first."""
        return np.append(0.0, np.maximum(np.diff(self.depth), 1e-3))

    @cached_property
    def effect(self) -> Floats:
        """Effect (2 k, 2 k) on e, then ξ, at all steps of a, then b, in all intervals."""
        size, after = len(self.depth), np.tri(len(self.depth))
        effect = np.zeros((2 * size, 2 * size))
        effect[:size, :size] = effect[size:, size:] = after
        effect[:size, size:] = after * (self.depth[:, None] - self.depth)
        return effect

    @cached_property
    def predicted(self) -> Floats:
        """Lateral motion and turn (2, k) in each interval beyond a straight continuation, as the model predicts."""
        straight = np.append(0.0, self.slope[:-1] * self.advance[1:])
        return np.stack(
            [
                np.diff(self.position, prepend=self.position[0]) - straight,
                np.diff(self.slope, prepend=self.slope[0]),
            ]
        )

    @cached_property
    def blocks(self) -> Floats:
        """Covariances (5, 2, 2, k) of the disturbances of each interval by `KINDS`, for standard deviations of 1."""
        size, (u, v), dx = len(self.depth), self.predicted, self.advance
        blocks = np.zeros((_INTERVALS, 2, 2, size))
        blocks[0] = [[dx**3 / 3.0, dx**2 / 2.0], [dx**2 / 2.0, dx]]
        blocks[1, 0, 0] = dx
        blocks[2] = [[(v * dx) ** 2, v * v * dx], [v * v * dx, v * v]]
        blocks[3] = [[u * u, u * v], [u * v, v * v]]
        blocks[4, 0, 0] = v * v
        return blocks

    def unit_covariances(self, factors: Floats) -> Floats:
        """Return covariances (9, 2 k, 2 k) of e and ξ by `KINDS`, for standard deviations of 1; the last two are noise.

        factors (k,): on the variances of each interval.
        """
        size = len(self.depth)
        parts = [self.spread(block) for block in self.blocks * factors]
        parts += [np.outer(each, each) for each in self.whole]
        parts += [np.diag(np.repeat(each, size)) for each in ((1.0, 0.0), (0.0, 1.0))]
        return np.array(parts)

    @cached_property
    def whole(self) -> Floats:
        """Effects (2, 2 k) on e, then ξ, of the errors that the insertion has as a whole, for values of 1."""
        x = self.depth - self.depth[0]
        return np.stack([np.append(0.5 * x * x, x), self.effect @ self.predicted.ravel()])

    def spread(self, block: Floats) -> Floats:
        """Return the covariance (2 k, 2 k) at all steps of disturbances with covariances (2, 2, k)."""
        left = self.effect.reshape(-1, 2, len(self.depth))
        weighed = np.einsum("pik,ijk->pjk", left, block)
        found: Floats = weighed.reshape(len(left), -1) @ left.reshape(len(left), -1).T
        return found

    @cached_property
    def start(self) -> Floats:
        """Covariance (2 k, 2 k) of an unknown start."""
        size = len(self.depth)
        return self.spread(np.einsum("ij,k->ijk", np.diag(_START**2), np.eye(size)[0]))


@dataclass(frozen=True, eq=False)
class Whitened:
    """The likelihood of the residuals of a path on an axis.

    known (2 k,): positions and slopes that are measured; parts: `unit_covariances`, and start (2 k, 2 k), of those.
    """

    deviations: Deviations
    known: Floats
    factors: Floats

    @cached_property
    def parts(self) -> Floats:
        """Covariances (9, r, r) by `KINDS` of the r known values."""
        found: Floats = self.deviations.unit_covariances(self.factors)[:, self.known][:, :, self.known]
        return found

    @cached_property
    def start(self) -> Floats:
        """Covariance (r, r) of the start."""
        found: Floats = self.deviations.start[self.known][:, self.known]
        return found

    def covariance(self, noise: Noise) -> Floats:
        """Return the covariance (r, r) of the residuals."""
        readings = np.repeat(noise.sd[-2:] ** 2, len(self.deviations.depth))[self.known]
        found: Floats = self.latent(noise)[self.known][:, self.known] + np.diag(readings)
        return found

    def latent(self, noise: Noise) -> Floats:
        """Return the covariance (2 k, 2 k) of the deviations themselves, without errors of readings."""
        deviations, variance = self.deviations, noise.sd**2
        block = np.tensordot(variance[:_INTERVALS], deviations.blocks, 1) * self.factors
        whole = np.sqrt(variance[_INTERVALS:-2, None]) * deviations.whole
        return deviations.start + deviations.spread(block) + whole.T @ whole

    def with_factors_for(self, noise: Noise, residuals: Floats) -> "Whitened":
        """Return the same with the expected factors of the intervals, given the residuals (r,)."""
        deviations, factors = self.deviations, self.factors[1:]
        unit = np.tensordot(noise.sd[:_INTERVALS] ** 2, deviations.blocks[..., 1:], 1)
        effect = deviations.effect.reshape(len(self.known), 2, -1)[self.known, :, 1:]
        solved = cho_factor(self.covariance(noise), lower=True)
        pull = np.tensordot(cho_solve(solved, residuals), effect, 1)
        root = solve_triangular(solved[0], effect.reshape(len(residuals), -1), lower=True).reshape(
            effect.shape
        )
        excess = np.einsum("pik,pjk->ijk", root, root) - pull[:, None] * pull
        # The expected squared distance of a disturbance from 0, of 2 in the mean.
        distance = factors * (2.0 - factors * np.einsum("ijk,ijk->k", excess, unit))
        return replace(self, factors=np.append(1.0, (TAIL + distance) / (TAIL + 2.0)))


def estimate_noise(paths: Sequence[Whitened], residuals: Sequence[Floats], first: Noise) -> Noise:
    """Return the noise of the greatest likelihood of residuals, (r,) for each path on an axis."""

    def loss(logs: Floats) -> tuple[float, Floats]:
        variance, total, slope = np.exp(2.0 * logs), 0.0, np.zeros(len(KINDS))
        for path, left in zip(paths, residuals, strict=True):
            factor = cho_factor(path.start + np.tensordot(variance, path.parts, 1), lower=True)
            weighed = cho_solve(factor, left)
            total += left @ weighed + 2.0 * np.log(np.diag(factor[0])).sum()
            excess = cho_solve(factor, np.eye(len(left))) - np.outer(weighed, weighed)
            slope += np.tensordot(path.parts, excess, 2)
        return total, 2.0 * variance * slope

    found = minimize(
        loss, np.log(first.sd), jac=True, method="L-BFGS-B", bounds=np.log(_BOUNDS), options={"maxiter": 60}
    )
    return Noise(np.exp(found.x))
