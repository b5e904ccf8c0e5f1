"""Closed forms of textbooks. Beams are along x; EI in N·mm², k in N/mm² (foundation), P in N, lengths in mm."""

import numpy as np


def cantilever(x, P, EI, L):
    """y of a cantilever of length L with an end load P: P x²(3L − x)/6EI (docs/theory.md section 7)."""
    return P * x**2 * (3 * L - x) / (6 * EI)


def characteristic(k, EI):
    """β = (k/4EI)^¼ in 1/mm."""
    return (k / (4 * EI)) ** 0.25


def endless_beam(x, y0, beta):
    """Shape of an endless beam on springs that a point load at 0 moves by y0 (Hetényi 1946)."""
    s = beta * np.abs(x)
    return y0 * np.exp(-s) * (np.cos(s) + np.sin(s))


def free_end(x, P, k, beta):
    """Half-endless beam on springs, load P on its free end, x ≥ 0 away from it: (2Pβ/k) e^(−βx) cos βx."""
    return 2 * P * beta / k * np.exp(-beta * x) * np.cos(beta * x)


def free_end_slope(P, k, beta):
    """|θ| at the loaded free end: 2Pβ²/k."""
    return 2 * P * beta**2 / k


def steady_curvature(b, lb, k, EI):
    """κ of docs/theory.md eq. 10: F/(EIβ), F = k ℓ_b b/(1 + 2(βℓ_b)²)."""
    beta = characteristic(k, EI)
    return k * lb * b / (1 + 2 * (beta * lb) ** 2) / (EI * beta)


def guided_tip(base_y, base_turn, guide_y, arm, overhang, EI):
    """Tip y, θ and guide force of an unloaded needle: clamp, guide `arm` away, free beyond it by `overhang`."""
    offset = guide_y - base_y - base_turn * arm
    turn = base_turn + 1.5 * offset / arm
    return guide_y + turn * overhang, turn, 3 * EI * offset / arm**3
