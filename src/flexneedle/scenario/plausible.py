"""Valid but implausible values of a scenario: far from those of needles and tissues, or without effect."""

from collections.abc import Iterator
from typing import NamedTuple

from flexneedle.scenario.dotted import split_key
from flexneedle.scenario.model import Scenario
from flexneedle.scenario.problems import key_path


class Range(NamedTuple):
    """What a quantity usually is, in the unit of its key, and who has measured or made it."""

    low: float
    high: float
    source: str


_STANDARD = "tubing for needles, 34G to 10G, ISO 9626:2016"
USUAL = {
    "needle.outer_diameter_mm": Range(0.18, 3.4, _STANDARD),
    "needle.inner_diameter_mm": Range(0.05, 3.0, f"what walls leave of {_STANDARD}"),
    "needle.length_mm": Range(13, 200, "from hypodermic to brachytherapy needles, as sold"),
    "needle.youngs_modulus_gpa": Range(
        3, 210, "PEEK 3 to 4 (doi:10.1016/j.biomaterials.2007.07.013), nitinol 28 to 83, steel 190 to 210"
    ),
    "tissue.*.shear_modulus_kpa": Range(
        0.6, 210, "stomach 0.64, liver 1.8, gallbladder 85, artery 210 (doi:10.1088/1361-6560/ab5010)"
    ),
    "target.depth_mm": Range(
        4,
        200,
        "pen needles 4, lumbar puncture 20 to 130 (Am J Emerg Med 2005;23:742), brachytherapy needles 200",
    ),
    "setup.insertion_speed_mm_s": Range(
        1, 280, "robots from 1 (Hing et al., ICRA 2006), brachytherapy by hand up to 280"
    ),
}
"""By key; * is any layer. Sources are for the ends of the range."""

_FAR = 10**0.5  # ratio to the nearest usual value from which a value is reported: half an order of magnitude


def doubts(scenario: Scenario) -> list[str]:
    """Return a line for each value that is half an order of magnitude and more outside the usual range, or unused."""
    return [*_unusual(scenario), *_unused(scenario)]


def _unusual(scenario: Scenario) -> Iterator[str]:
    for key, value in scenario.flat().items():
        usual = USUAL.get(_general(key))
        if usual is None or value == 0 or 1.0 / _FAR < (ratio := _ratio(value, usual)) < _FAR:
            continue
        off = (
            f"{ratio:.3g} times the largest" if ratio > 1.0 else f"{1.0 / ratio:.3g} times below the smallest"
        )
        line = f"{off} usual value, {usual.low:g} to {usual.high:g} ({usual.source}): check the unit"
        yield f"{key_path(split_key(key))} = {value:g}: {line}"


def _unused(scenario: Scenario) -> Iterator[str]:
    last = len(scenario.tissue) - 1
    thickness = scenario.tissue[last].thickness_mm
    if thickness is not None:
        rule = "has no effect: the last layer has no end; leave it out, or add the layer below"
        yield f"tissue[{last}].thickness_mm = {thickness:g}: {rule}"


def _general(key: str) -> str:
    parts = split_key(key)
    return ".".join("*" if isinstance(part, int) else part for part in parts)


def _ratio(value: float, usual: Range) -> float:
    """Ratio of a value to the nearest value in a range."""
    return value / min(max(value, usual.low), usual.high)
