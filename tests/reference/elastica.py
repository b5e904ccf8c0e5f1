"""The elastica in closed form: a cantilever of any deflection under a dead load, by elliptic integrals."""

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipkinc


def cantilever(load: float) -> tuple[float, float, float]:
    """Tip (x/L, y/L, θ) of a cantilever along x under a dead load P across it at its end; load = PL²/EI > 0.

    With EI θ″ = −P cos θ, k² = (1 + sin θ_t)/2 and sin φ = 1/(k√2) (Bisshopp and Drucker 1945):
    √(PL²/EI) = K(k) − F(φ, k), y/L = 1 − 2 (E(k) − E(φ, k))/√(PL²/EI), x/L = √(2 sin θ_t)/√(PL²/EI).
    """

    def length(turn: float) -> float:
        m, phi = _amplitude(turn)
        return float(ellipkinc(np.pi / 2, m) - ellipkinc(phi, m))

    root = np.sqrt(load)
    turn = brentq(lambda angle: length(angle) - root, 1e-9, np.pi / 2 - 1e-12, xtol=1e-15, rtol=1e-14)
    m, phi = _amplitude(turn)
    y = 1.0 - 2.0 * (ellipeinc(np.pi / 2, m) - ellipeinc(phi, m)) / root
    return float(np.sqrt(2.0 * np.sin(turn)) / root), float(y), float(turn)


def _amplitude(turn: float) -> tuple[float, float]:
    m = 0.5 * (1.0 + np.sin(turn))
    return m, np.arcsin(1.0 / np.sqrt(2.0 * m))


def buckling_load(length: float, stiffness: float) -> float:
    """Greatest axial load (N) that a straight clamped, free column carries: π²EI/4L² (Euler 1744)."""
    return np.pi**2 * stiffness / (4.0 * length**2)


def arc_tip(length: float, curvature: float) -> tuple[float, float, float]:
    """Tip of an arc that starts along x at the origin: sin κL/κ, (1 − cos κL)/κ, κL."""
    turn = curvature * length
    return np.sin(turn) / curvature, (1.0 - np.cos(turn)) / curvature, turn


def twisted_buckling_moment(length: float, stiffness: float, push: float = 0.0) -> float:
    """Twisting moment (N·mm) that buckles a straight rod, clamped at both ends, under an axial load (Greenhill 1883).

    Lateral w = y + iz: EI w⁗ − iT w‴ + P w″ = 0, so w = a + bs + c e^(iλ₁s) + d e^(iλ₂s) with EI λ² − Tλ − P = 0.
    Without an axial load T L/EI = 8.987, the smallest solution of tan(T L/2EI) = T L/2EI.
    """

    def miss(moment: float) -> float:
        root = np.sqrt(moment**2 + 4.0 * stiffness * push)
        waves = np.array([moment + root, moment - root]) / (2.0 * stiffness)
        end = np.exp(1j * waves * length)
        shape = np.array(
            [[1, 0, 1, 1], [0, 1, *(1j * waves)], [1, length, *end], [0, 1, *(1j * waves * end)]]
        )
        return float(np.imag(np.linalg.det(shape) * np.exp(-0.5j * length * waves.sum())))

    if push == 0.0:  # two of the four solutions are the same
        return float(2.0 * stiffness / length * brentq(lambda x: np.tan(x) - x, 4.4, 4.6))
    moments = np.linspace(0.0, 9.5, 400) * stiffness / length
    values = [miss(moment) for moment in moments]
    first = next(k for k in range(1, len(values)) if values[k - 1] * values[k] < 0.0)
    return float(brentq(miss, moments[first - 1], moments[first]))
