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
