"""Published values of the paper's tracker, for comparison with measurements.

OFFICIAL: the manufacturer's values (NDI 2013) as quoted in Table I of the paper; MEASURED: the paper's own, Tables I
and II. Text and tables of the paper differ (0.17 and 0.25 mm against 0.65 and 0.61 mm): these are the tables' values.
"""

import re
from collections.abc import Mapping

from flexneedle.lab.tables.columns import REFERENCE
from flexneedle.types import TIP

IDEAL, NOISY = "ideal", "noisy"
"""The paper's environments: with nothing but the stage nearby, and above a metal plate."""

Figures = Mapping[str, float]

OFFICIAL: Mapping[str, Figures] = {
    TIP: {"rmse_mm": 0.70, "p95_mm": 1.40},
    REFERENCE: {"rmse_mm": 0.48, "p95_mm": 0.88},
}
MEASURED: Mapping[tuple[str, str], Figures] = {
    (TIP, IDEAL): {"rmse_mm": 0.65, "p95_mm": 1.10, "max_mm": 1.40, "jitter_mm": 0.07},
    (TIP, NOISY): {"rmse_mm": 1.53, "p95_mm": 3.20, "max_mm": 4.36, "jitter_mm": 0.04},
    (REFERENCE, IDEAL): {"rmse_mm": 0.61, "p95_mm": 0.91, "max_mm": 1.16, "jitter_mm": 0.08},
    (REFERENCE, NOISY): {"rmse_mm": 2.70, "p95_mm": 5.27, "max_mm": 8.16, "jitter_mm": 0.07},
}
THRESHOLD = 0.0547
"""95th percentile of the indicator in `ideal`."""
INDICATOR: Mapping[str, Figures] = {
    IDEAL: {"mean": 0.0239, "sd": 0.0138, "max": 0.0779, "min": 0.0061, "p95": THRESHOLD},
    NOISY: {"mean": 0.1944, "sd": 0.1049, "max": 0.4784, "min": 0.0684},
}
FITS: Figures = {"mean_mm": 0.575, "sd_mm": 0.211, "slope_mm": 9.591, "intercept_mm": 0.051}
"""Fits of the reference sensor: err = mean ± sd in `ideal`, err = slope · 𝓘 + intercept in `noisy`."""
POWERED = 0.04
"""The indicator with the needle driver's power on."""
_REFERENCE = re.compile(rf"(ref|{REFERENCE})\d*")


def find_paper_sensor(sensor: str) -> str | None:
    """Return the paper's sensor of this name: the tip, a reference (ref, ref1, …), or None."""
    name = sensor.strip().lower()
    if name == TIP:
        return TIP
    return REFERENCE if _REFERENCE.fullmatch(name) else None
