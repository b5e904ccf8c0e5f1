"""The needle: a tube or rod with a bevel at its tip."""

from math import pi
from typing import Literal, get_args

from pydantic import model_validator

from flexneedle.scenario.problems import Problem, refuse
from flexneedle.scenario.sections.fields import NonNegative, Positive, Section, count

Gauge = Literal["17G", "18G", "19G", "20G", "21G", "22G", "23G", "24G", "25G", "26G", "27G"]

_DIAMETERS = (
    (1.473, 1.067),
    (1.270, 0.838),
    (1.067, 0.686),
    (0.908, 0.603),
    (0.819, 0.514),
    (0.718, 0.413),
    (0.641, 0.337),
    (0.565, 0.311),
    (0.514, 0.260),
    (0.464, 0.260),
    (0.413, 0.210),
)
GAUGES: dict[str, tuple[float, float]] = dict(zip(get_args(Gauge), _DIAMETERS, strict=True))
"""Nominal outer and inner diameter, mm, of regular-wall needles: the usual needle gauge chart, which follows
the Birmingham wire gauge, rounded to 0.001 mm."""


class Bevel(Section):
    """Section `needle.bevel`: the bevel as a pre-compressed spring at the tip."""

    offset_mm: NonNegative = 4.0
    """b, compression of the tip spring; 0: symmetric tip."""
    length_mm: Positive = 3.0
    """ℓ_b, length behind the tip over which the spring acts."""


class Needle(Section):
    """Section `needle`. The cross-section is given by `gauge` or by diameters."""

    gauge: Gauge | None = None
    """Gauge of a regular-wall needle; replaces the diameters."""
    stylet: bool = False
    """Whether a stylet, sensor or wire fills the tube, which then bends like a solid rod."""
    outer_diameter_mm: Positive | None = None
    """Outer diameter, required without `gauge`."""
    inner_diameter_mm: NonNegative | None = None
    """Inner diameter. Not set or 0: solid needle."""
    length_mm: Positive = 150.0
    """Length from base clamp to tip."""
    youngs_modulus_gpa: Positive = 200.0
    """E, Young's modulus."""
    nodes: int = count(61, least=2, most=10_000)
    """n, nodes of recorded needle shapes, at equal arc lengths. No result depends on it."""
    bevel: Bevel = Bevel()

    @model_validator(mode="after")
    def _check_cross_section(self) -> "Needle":
        refuse(self._cross_section_problems())
        return self

    def _cross_section_problems(self) -> list[Problem]:
        outer, inner = self.outer_diameter_mm, self.inner_diameter_mm
        if self.gauge is not None:
            both = [
                key for key in ("outer_diameter_mm", "inner_diameter_mm") if getattr(self, key) is not None
            ]
            rule = f"leave it out: gauge {self.gauge} gives it; both diameters replace the gauge"
            return [Problem(key, getattr(self, key), rule) for key in both]
        if outer is None:
            return [Problem("outer_diameter_mm", None, "missing: give it, or a gauge such as 21G")]
        if inner is not None and inner >= outer:
            return [Problem("inner_diameter_mm", inner, f"must be below outer_diameter_mm ({outer:g})")]
        return []

    @property
    def outer_diameter(self) -> float:
        """d, mm, from the diameters or the gauge."""
        if self.gauge is not None:
            return GAUGES[self.gauge][0]
        return self.outer_diameter_mm or 0.0

    @property
    def inner_diameter(self) -> float:
        """d_i, mm, from the diameters or the gauge; 0 with a stylet."""
        if self.stylet:
            return 0.0
        if self.gauge is not None:
            return GAUGES[self.gauge][1]
        return self.inner_diameter_mm or 0.0

    @property
    def youngs_modulus(self) -> float:
        """E, MPa."""
        return 1e3 * self.youngs_modulus_gpa

    @property
    def second_moment(self) -> float:
        """I = π (d⁴ − d_i⁴) / 64 of a ring, mm⁴."""
        return pi * (self.outer_diameter**4 - self.inner_diameter**4) / 64

    @property
    def bending_stiffness(self) -> float:
        """E I, N·mm²."""
        return self.youngs_modulus * self.second_moment
