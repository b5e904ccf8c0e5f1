"""The parameters of a calibration: what each one changes in a scenario, with its prior.

Only products can be identified from positions of the tip: the tissue's foundation relative to the needle's bending
stiffness k₀/EI (here a factor on the moduli), and the bevel's offset times its length (here the offset).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flexneedle.errors import InputError
from flexneedle.mechanics.model import Adaptation, Model
from flexneedle.phantom.drift import scale_moduli
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Floats

NAMES = ("stiffness", "bevel", "guide", "clearance", "yield", "drift")
_FIRST_YIELD = 0.2  # of the outer diameter of the needle
_BEHIND_MM = 1.0  # of the needle behind the guide at the deepest step and at the target, at least
_NONE = 1e-2  # from the bound that means none
_CURVATURE = 0.75  # power of the stiffness in the curvature of a free path (docs/theory.md eq. 10)


@dataclass(frozen=True)
class Parameter:
    """A number that is fitted.

    Attributes:
        name: Its name; several may have one, such as the axes of the bevel.
        label: Its label in tables.
        start: Mean of its prior, in the coordinate of the fit: the logarithm of a positive quantity.
        sd: Standard deviation of its prior.
        low, high: Bounds.
        step: Step of a finite difference.
        useful: Half of a 95 % interval from which the parameter counts as not identified.
        log: Whether the coordinate is a logarithm.
        unit: Unit of its value.
        absent: Whether the scenario has no value; then the upper bound means none.
    """

    name: str
    label: str
    start: float
    sd: float
    low: float
    high: float
    step: float
    useful: float
    log: bool = True
    unit: str = ""
    absent: bool = False

    @property
    def own(self) -> float:
        """Its value in the scenario."""
        return self.high if self.absent else self.start

    def is_none(self, coordinate: float) -> bool:
        """Return whether a coordinate means no value."""
        return self.absent and coordinate > self.high - _NONE

    def value(self, coordinate: float) -> float:
        """Return the value of a coordinate."""
        return math.exp(coordinate) if self.log else coordinate

    def format_width(self, width: float) -> str:
        """Return the half-width of an interval as text: a factor to either side for a logarithm."""
        if self.log:
            return f"×÷ {math.exp(min(width, 99.0)):.3g}"
        return f"± {width:.2g} {self.unit}".rstrip()


class Trial(NamedTuple):
    """Values of all parameters: factors on the moduli by layer, bevel (axes,) in mm, and so on."""

    stiffness: Floats
    bevel: Floats
    guide_mm: float | None
    clearance_mm: float
    yield_mm: float | None
    drift: float  # change of ln of the moduli from the first insertion of a session to the next


def parameters_of(scenario: Scenario, names: Sequence[str], reached: float) -> tuple[Parameter, ...]:
    """Return the parameters of a fit by name, for recordings to a depth (mm). Raises InputError for others."""
    if unknown := [name for name in names if name not in NAMES]:
        raise InputError(f"fit = {unknown[0]}: must be one of {', '.join(NAMES)}")
    return tuple(each for name in NAMES if name in names for each in _MAKERS[name](scenario, reached))


def find_parameter(parameters: Sequence[Parameter], name: str) -> int:
    """Return the place of a parameter by its name or its label. Raises InputError for another."""
    chosen = [k for k, each in enumerate(parameters) if name in (each.name, each.label)]
    if len(chosen) != 1:
        labels = ", ".join(each.label for each in parameters)
        raise InputError(f"profile = {name}: must be one of {labels}")
    return chosen[0]


def _stiffness(scenario: Scenario, reached: float) -> Iterator[Parameter]:
    for layer, top in zip(scenario.tissue, scenario.layer_tops, strict=True):
        if top < reached:
            label = f"stiffness of {layer.name}"
            yield Parameter("stiffness", label, 0.0, 3.0, math.log(1e-3), math.log(1e3), 0.05, math.log(4.0))


def _bevel(scenario: Scenario, _reached: float) -> Iterator[Parameter]:
    offset, most = scenario.needle.bevel.offset_mm, min(layer.most_bevel_mm for layer in scenario.tissue)
    scale = max(offset, 0.1)
    axes = ("y", "z")[: scenario.setup.axes]
    for axis in axes:
        first = offset if axis == "y" else 0.0
        label = "bevel" if len(axes) == 1 else f"bevel along {axis}"
        yield Parameter(
            "bevel", label, first, 10.0 * scale, -0.7 * most, 0.7 * most, 0.05 * scale, math.inf, False, "mm"
        )


def _guide(scenario: Scenario, reached: float) -> Iterator[Parameter]:
    if scenario.setup.guide_to_skin_mm is None:
        raise InputError("fit = guide: the scenario has no guide (setup.guide_to_skin_mm)")
    first = math.log(scenario.setup.guide_to_skin_mm)
    low = max(first - 1.0, math.log(scenario.setup.tip_to_skin_mm) + 1e-3)  # the tip starts before the guide
    deepest = max(reached, scenario.target.depth_mm)
    longest = max(scenario.needle.length_mm - deepest - _BEHIND_MM, scenario.setup.guide_to_skin_mm)
    high = min(first + 1.0, math.log(longest))
    yield Parameter("guide", "guide to skin", first, 0.1, low, high, 0.02, math.log(1.35), True, "mm")


def _clearance(scenario: Scenario, _reached: float) -> Iterator[Parameter]:
    if scenario.setup.guide_to_skin_mm is None:
        raise InputError("fit = clearance: the scenario has no guide (setup.guide_to_skin_mm)")
    first = scenario.setup.guide_clearance_mm or 0.05
    yield Parameter("clearance", "clearance of the guide", first, 0.05, 0.0, 1.0, 0.02, 0.06, False, "mm")


def _yield(scenario: Scenario, _reached: float) -> Iterator[Parameter]:
    known = _yield_of(scenario)
    first = math.log(known or _FIRST_YIELD * scenario.needle.outer_diameter)
    low, high = math.log(0.02), math.log(min(layer.compression_length_mm for layer in scenario.tissue) * 0.69)
    first, useful, absent = min(first, high), math.log(4.0), known is None
    yield Parameter(
        "yield", "displacement that tears", first, 0.75, low, high, 0.05, useful, True, "mm", absent
    )


def _drift(_scenario: Scenario, _reached: float) -> Iterator[Parameter]:
    label = "drift (ln stiffness per insertion)"
    yield Parameter("drift", label, 0.0, 0.05, -0.3, 0.3, 0.01, 0.05, False)


_MAKERS = {
    "stiffness": _stiffness, "bevel": _bevel, "guide": _guide,
    "clearance": _clearance, "yield": _yield, "drift": _drift,
}  # fmt: skip


def _yield_of(scenario: Scenario) -> float | None:
    values = [each for layer in scenario.tissue if (each := getattr(layer, "yield_mm", None)) is not None]
    return min(values, default=None)


def at_same_curvature(parameters: Sequence[Parameter], point: Floats, log_factor: float) -> Floats:
    """Return a point whose bevel gives a free path the same curvature with a stiffness changed by e^log_factor."""
    bevel = np.array([each.name == "bevel" for each in parameters])
    found = point.copy()
    found[: len(parameters)][bevel] *= math.exp(-_CURVATURE * log_factor)
    return found


def trial_of(scenario: Scenario, parameters: Sequence[Parameter], point: Floats) -> Trial:
    """Return the values of all parameters at a point (p,) of the fit; the scenario's for those that are not fitted."""
    found: dict[str, list[float]] = {}
    for parameter, coordinate in zip(parameters, point.tolist(), strict=True):
        if parameter.is_none(coordinate):
            continue
        found.setdefault(parameter.name, []).append(parameter.value(coordinate))
    stiffness = np.ones(len(scenario.tissue))
    factors = found.get("stiffness", [])
    stiffness[: len(factors)] = factors
    if factors:
        stiffness[len(factors) :] = factors[-1]
    bevel = [scenario.needle.bevel.offset_mm, 0.0][: scenario.setup.axes]

    def single(name: str, default: float | None) -> float | None:
        return found[name][0] if name in found else default

    return Trial(
        stiffness,
        np.array(found.get("bevel", bevel)),
        single("guide", scenario.setup.guide_to_skin_mm),
        single("clearance", scenario.setup.guide_clearance_mm or 0.0) or 0.0,
        single("yield", _yield_of(scenario)),
        single("drift", 0.0) or 0.0,
    )


def with_trial(scenario: Scenario, trial: Trial) -> Scenario:
    """Return the scenario with the values of a trial: moduli, bevel, guide, law. The bevel's direction is not in it."""
    changes: dict[str, object] = {
        f"tissue.{k}.shear_modulus_kpa": layer.shear_modulus_kpa * factor
        for k, (layer, factor) in enumerate(zip(scenario.tissue, trial.stiffness.tolist(), strict=True))
    }
    changes["needle.bevel.offset_mm"] = float(np.linalg.norm(trial.bevel))
    if trial.guide_mm is not None:
        changes |= _with_guide(scenario, trial.guide_mm)
        changes["setup.guide_clearance_mm"] = trial.clearance_mm
    return _with_yield(scenario, trial.yield_mm).with_values(changes)


def _with_guide(scenario: Scenario, guide_mm: float) -> dict[str, object]:
    """Return the changes for a distance of the guide; a stroke with which the base would reach it is shortened."""
    room = scenario.needle.length_mm - guide_mm + scenario.setup.tip_to_skin_mm
    return {
        "setup.guide_to_skin_mm": guide_mm,
        "setup.stroke_mm": min(scenario.setup.stroke_mm, room * (1.0 - 1e-9)),
    }


def _with_yield(scenario: Scenario, yield_mm: float | None) -> Scenario:
    """Return the scenario with layers of the Ogden law that tear from a displacement (mm)."""
    if yield_mm is None:
        return scenario
    layers = [layer.model_dump(mode="json", exclude_none=True) for layer in scenario.tissue]
    torn = [
        each | {"law": "tearing", "yield_mm": yield_mm} if each["law"] in ("ogden", "tearing") else each
        for each in layers
    ]
    return scenario.with_values({"tissue": torn})


class Needle(NamedTuple):
    """A needle with the values of a trial: its simulator, the roll of its bevel, and the drift of its tissue."""

    simulator: Simulator
    roll: float
    drift: float

    def model(self, order: float) -> Model:
        """Return the constants in an insertion by its place in the session."""
        model = self.simulator.model
        return scale_moduli(model, math.exp(self.drift * order)) if self.drift != 0.0 else model


def make_needle(scenario: Scenario, trial: Trial) -> Needle:
    """Return the needle of a trial."""
    changed = _with_yield(scenario, trial.yield_mm)
    if trial.guide_mm is not None:
        changed = changed.with_values(_with_guide(scenario, trial.guide_mm))
    simulator, size = Simulator(changed), float(np.linalg.norm(trial.bevel))
    model = simulator.adapt(
        Adaptation(np.zeros(len(trial.stiffness) - 1), trial.stiffness, clearance=trial.clearance_mm)
    )._replace(bevel_offset=size)
    direction = complex(*trial.bevel) if size > 0.0 else 1.0
    return Needle(simulator.with_model(model), float(np.angle(direction)), trial.drift)
