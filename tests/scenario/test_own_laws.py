"""Custom laws: the required definitions, and functions that are consistent with each other."""

import sys
from runpy import run_path
from types import ModuleType

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import ScenarioError
from markdown_examples import EXAMPLES

SIZE = {"shear_modulus_kpa": 3.63, "compression_length_mm": 20.0, "engaged_width_mm": 5.2}
Fung = run_path(str(EXAMPLES / "fung.py"))["Fung"]
"""The exponential law of docs/extend.md."""


class Bilinear(Fung):
    """Ten times as stiff beyond a tenth."""

    limit = 0.5

    def energy(self, e):
        return 0.5 * e**2 + 4.5 * np.maximum(e - 0.1, 0.0) ** 2

    def force(self, e):
        return e + 9.0 * np.maximum(e - 0.1, 0.0)

    def stiffness(self, e):
        return np.where(e > 0.1, 10.0, 1.0)


def raises(_self, _e):
    raise ZeroDivisionError("no tissue")


# Parts of a law that differ from Fung, or from its bases, and the message.
WRONG = {
    "force not of the energy": (
        {"force": lambda _, e: e, "stiffness": lambda _, e: np.ones_like(e)},
        "force must be the derivative of energy, but is not at e = ",
    ),
    "stiffness not of the force": (
        {"stiffness": lambda _, e: np.ones_like(e)},
        "stiffness must be the derivative of force, but is not at e = ",
    ),
    "not scaled": (
        {
            "energy": lambda _, e: e**2,
            "force": lambda _, e: 2 * e,
            "stiffness": lambda _, e: np.full_like(e, 2.0),
        },
        "energy, force and stiffness at e = 0 must be 0, 0 and 1, not 0, 0, 2",
    ),
    "softens": (
        {
            "energy": lambda _, e: 0.09 * (1 - np.cos(e / 0.3)),
            "force": lambda _, e: 0.3 * np.sin(e / 0.3),
            "stiffness": lambda _, e: np.cos(e / 0.3),
        },
        "stiffness must be above 0 up to limit = 0.7",
    ),
    "one number": (
        {"stiffness": lambda *_: 1.0},
        "stiffness must return an array of the shape of e, (4097,), not ()",
    ),
    "infinite": ({"energy": lambda _, e: e / (0.7 - e)}, "energy must be finite up to limit = 0.7"),
    "raises": ({"force": raises}, "force raises ZeroDivisionError: no tissue"),
    "limit": ({"limit": 1.5}, "limit = 1.5: must be above 0 and below 1"),
    "no functions": (
        {"bases": (flexneedle.Layer,), "force": Fung.force},
        "must define limit, energy, stiffness",
    ),
}


def scenario(monkeypatch, law):
    module = ModuleType("own_laws")
    module.Law = law
    monkeypatch.setitem(sys.modules, "own_laws", module)
    return flexneedle.load_scenario("phantom").with_values(
        {"tissue": [{"law": "own_laws:Law", "exponent": 6.0, **SIZE}]}
    )


@pytest.mark.parametrize("law", [Fung, Bilinear])
def test_a_law_whose_functions_belong_together_is_accepted(monkeypatch, law):
    """Also a law with a kink."""
    assert isinstance(scenario(monkeypatch, law).tissue[0], law)


@pytest.mark.parametrize(("parts", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_law_is_refused_in_one_line(monkeypatch, parts, message):
    law = type(
        "Wrong", parts.get("bases", (Fung,)), {key: one for key, one in parts.items() if key != "bases"}
    )
    with pytest.raises(ScenarioError) as caught:
        scenario(monkeypatch, law)
    assert str(caught.value).startswith('tissue[0].law = "own_laws:Law": ' + message)
    assert "\n" not in str(caught.value)
