"""Checks that all kits share, and the scenario on which they run."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np

from flexneedle.errors import describe_error
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario

_SHORT: dict[str, Any] = {
    "setup.tip_to_skin_mm": 4.0,
    "target.depth_mm": 10.0,
    "target.lateral_mm": 0.5,
    "plan.samples": 64,
    "plan.iterations": 10,
    "plan.max_iterations": 10,
}
_IDEAL: dict[str, Any] = {
    "phantom.shear_modulus_factor": (1.0, 1.0),
    "phantom.shear_modulus_variation": 0.0,
    "phantom.layer_shift_sd_mm": 0.0,
    "phantom.bevel_factor": (1.0, 1.0),
    "phantom.start_offset_sd_mm": 0.0,
    "phantom.start_angle_sd_mrad": 0.0,
    "phantom.start_axial_sd_mm": 0.0,
    "phantom.youngs_modulus_variation": 0.0,
    "phantom.initial_bend_mm": 0.0,
    "phantom.run_out_mm": 0.0,
    "phantom.guide_clearance_mm": 0.0,
    "phantom.missing_fraction": 0.0,
    "phantom.contact_spacing_mm": 1.0,
    "phantom.element_mm": 2.0,
    "phantom.step_mm": 1.0,
}


def short_scenario() -> Scenario:
    """Return the shipped phantom with a target at 10 mm, a quick planner, and no errors of the phantom."""
    return load_scenario("phantom").with_values(_SHORT | _IDEAL)


def require(condition: object, message: str) -> None:
    """Raise AssertionError with a message unless a condition holds."""
    if not condition:
        raise AssertionError(message)


@contextmanager
def require_error(call: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise AssertionError unless the block raises an error of one of these classes."""
    wanted = f"{call} must raise {' or '.join(kind.__name__ for kind in kinds)}"
    try:
        yield
    except kinds:
        return
    except Exception as error:
        raise AssertionError(f"{wanted}, not {describe_error(error)}") from error
    raise AssertionError(wanted)


def require_parts(name: str, part: object, *wanted: str) -> None:
    """Raise AssertionError unless an object has these methods and attributes."""
    missing = [one for one in wanted if not hasattr(part, one)]
    require(not missing, f"{name} {type(part).__name__} lacks {', '.join(missing)}")


def require_finite(name: str, values: Any) -> None:
    """Raise AssertionError unless all values are finite numbers."""
    require(np.isfinite(np.asarray(values, dtype=float)).all(), f"{name} must be finite, not {values}")


def require_increasing(name: str, values: list[float]) -> None:
    """Raise AssertionError unless each value is above the one before."""
    for before, after in pairwise(values):
        require(after > before, f"{name} must increase: {after} follows {before}")
