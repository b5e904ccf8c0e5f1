"""Ogden's law of the tissue, written out as in docs/theory.md, equations 1 to 3."""

from typing import NamedTuple

import numpy as np

_FLOOR = 0.3


class Tissue(NamedTuple):
    """Contact points or pieces of the tip spring, arrays (k,): Ogden's μ (MPa) and α, h (mm), volume V (mm³)."""

    mu: np.ndarray
    alpha: np.ndarray
    h: np.ndarray
    volume: np.ndarray

    def take(self, which) -> "Tissue":
        """Return the chosen entries."""
        return Tissue(*(values[which] for values in self))


class Response(NamedTuple):
    """Tissue at a compression: energy (mJ), force on the needle (N), stiffness along and across it (N/mm)."""

    energy: np.ndarray
    force: np.ndarray
    along: np.ndarray
    across: np.ndarray


def ogden(tissue: Tissue, u) -> Response:
    """Return the response to the compression u (mm), y or y + iz: equations 1 to 3, with the floor."""
    mu, alpha, h, volume = tissue
    size = np.abs(u)
    stretch = 1.0 - size / h
    lam = np.maximum(stretch, _FLOOR)
    beyond = (lam - stretch) * h
    energy = volume * 2 * mu / alpha**2 * (2 * lam ** (-alpha / 2) + lam**alpha - 3)
    push = 2 * mu * volume / (alpha * h) * (lam ** (-alpha / 2 - 1) - lam ** (alpha - 1))
    stiffness = (
        2
        * mu
        * volume
        / (alpha * h**2)
        * ((alpha - 1) * lam ** (alpha - 2) + (alpha / 2 + 1) * lam ** (-alpha / 2 - 2))
    )
    energy = energy + push * beyond + stiffness * beyond**2 / 2
    push = push + stiffness * beyond
    across = np.divide(push, size, out=stiffness.copy(), where=size > 0.0)
    return Response(energy, -push * np.sign(u), stiffness, across)
