"""Lines of the page that are compared are distinguished by people without one kind of cones as well."""

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import flexneedle.lab.page

STYLE = Path(flexneedle.lab.page.__file__).parent / "static" / "style.css"
COLOR = re.compile(r"--([a-z-]+): light-dark\(#([0-9a-f]{6}), #([0-9a-f]{6})\)")
SCHEMES = ("light", "dark")
# Of linear RGB, severity 1: Machado, Oliveira and Fernandes 2009, table 1 (doi 10.1109/TVCG.2009.113).
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
RGB_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
LEAST = 10.0
"""CIE76 distance of two lines; 2.3 is just noticed where two areas touch."""
IN_VIEWS = ("plan", "estimate", "predicted", "true", "needle", "second", "measured")
IN_PLOTS = ("estimate", "true", "guide", "needle", "measured")
COMPARED = {
    ("manipulation", "steering"),
    *combinations(IN_VIEWS, 2),
    *((name, "second") for name in IN_PLOTS),
}
"""Other lines of one picture differ by width, dashes or form."""


def palette(scheme):
    """Linear RGB of each colour by name."""
    found = {name: texts[SCHEMES.index(scheme)] for name, *texts in COLOR.findall(STYLE.read_text())}
    encoded = {name: np.frombuffer(bytes.fromhex(text), np.uint8) / 255.0 for name, text in found.items()}
    return {
        name: np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        for name, part in encoded.items()
    }


def lab(rgb):
    """CIELAB of linear RGB, white point D65."""
    share = RGB_TO_XYZ @ np.clip(rgb, 0.0, 1.0) / RGB_TO_XYZ.sum(axis=1)
    x, y, z = np.where(share > (6 / 29) ** 3, np.cbrt(share), share / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


def distances(scheme, vision):
    colors = palette(scheme)
    seen = {name: lab(VISIONS[vision] @ colors[name]) for pair in COMPARED for name in pair}
    return {pair: float(np.linalg.norm(np.subtract(*(seen[name] for name in pair)))) for pair in COMPARED}


def test_a_colour_in_lab_is_as_tables_have_it():
    np.testing.assert_allclose(lab(np.array([1.0, 0.0, 0.0])), (53.24, 80.09, 67.20), atol=0.02)
    np.testing.assert_allclose(lab(np.ones(3)), (100.0, 0.0, 0.0), atol=0.02)


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_lines_that_are_compared_differ(scheme, vision):
    near = {pair: round(far, 1) for pair, far in distances(scheme, vision).items() if far < LEAST}
    assert near == {}
