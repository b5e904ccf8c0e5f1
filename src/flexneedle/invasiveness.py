"""Load on the tissue over a whole insertion: stored energy, compression, motion of the guide, rolls."""

from dataclasses import dataclass
from math import isnan
from typing import Self

import numpy as np

from flexneedle.types import Floats

_UJ = 1e3  # µJ per mJ


@dataclass(frozen=True)
class Invasiveness:
    """Load on the tissue from the start to the end of a plan or an insertion. NaN: unknown.

    Attributes:
        peak_energy_uj: Largest energy stored in the tissue, weighted by layer (µJ), at the end of a step.
        mean_energy_uj: Its mean over the depth of the tip: ∫W dx / ∫dx, trapezoid rule over the deepest position
            reached in the tissue, so that a needle at rest does not count.
        end_energy_uj: Its value at the end.
        energy_scale_uj: E₁, energy of all tissue down to the target displaced by 1 mm: see `Scenario.energy_scale`.
        least_stretch: Least stretch λ of the tissue.
        guide_travel_mm: Path of the guide, Σ|Δg| over the steps that end with the tip in the tissue.
        rolls: Number of rolls of the bevel.
        estimated: Whether the tissue is the controller's estimate, as on a rig.
    """

    peak_energy_uj: float
    mean_energy_uj: float
    end_energy_uj: float
    energy_scale_uj: float
    least_stretch: float
    guide_travel_mm: float
    rolls: int
    estimated: bool = False

    @classmethod
    def measure(
        cls,
        depth: Floats,
        energy: Floats,
        *,
        scale: float,
        stretch: Floats,
        guide_steps: Floats,
        rolls: int,
        estimated: bool = False,
    ) -> Self:
        """Return the load of a path of m steps.

        Args:
            depth: Position x of the tip at the start and after each step (m + 1,), mm.
            energy: Energy stored in the tissue there (m + 1,), mJ.
            scale: E₁ (mJ).
            stretch: Least stretches of the tissue.
            guide_steps: Motion y, z of the guide in each step (m, 2), mm.
            rolls: Number of rolls of the bevel.
            estimated: Whether energy and stretch are estimates.
        """
        deepest = np.maximum.accumulate(np.maximum(depth, 0.0))
        travel, end = float(deepest[-1] - deepest[0]), float(energy[-1])
        mean = float(np.trapezoid(energy, deepest)) / travel if travel > 0.0 else end
        return cls(
            _UJ * float(energy.max()),
            _UJ * mean,
            _UJ * end,
            _UJ * scale,
            float(np.min(stretch, initial=1.0)),
            float(np.hypot(*guide_steps[depth[1:] > 0.0].T).sum()),
            rolls,
            estimated,
        )

    @property
    def energies_uj(self) -> tuple[float, float, float]:
        """Peak, mean and end of the energy (µJ)."""
        return self.peak_energy_uj, self.mean_energy_uj, self.end_energy_uj

    @property
    def relative_energies(self) -> tuple[float, float, float]:
        """Peak, mean and end of the energy relative to E₁; NaN if E₁ is unknown or 0."""
        scale = self.energy_scale_uj if self.energy_scale_uj > 0.0 else np.nan
        peak, mean, end = (energy / scale for energy in self.energies_uj)
        return peak, mean, end

    @property
    def energies(self) -> str:
        """Peak, mean and end of the energy as text."""
        peak, mean, end = map(format_number, self.energies_uj)
        return f"peak {peak}, mean {mean}, end {end} µJ"

    def rows(self) -> dict[str, str]:
        """Return the values as text by name, for tables."""
        tissue = "estimated tissue" if self.estimated else "tissue"
        energies, relative = (
            ", ".join(map(format_number, values)) for values in (self.energies_uj, self.relative_energies)
        )
        return {
            f"{tissue} energy: peak, mean, end": f"{energies} µJ",
            "  relative to E₁": relative,
            f"least stretch of the {tissue}": format_number(self.least_stretch),
            "guide travel in the tissue": f"{self.guide_travel_mm:.2f} mm",
            "bevel rolls": str(self.rolls),
        }

    def __str__(self) -> str:
        return "; ".join(f"{name.strip()} {text}" for name, text in self.rows().items())


def format_number(value: float) -> str:
    """Return a number with three significant digits, "–" if unknown."""
    return "–" if isnan(value) else f"{float(f'{value:.3g}'):g}"
