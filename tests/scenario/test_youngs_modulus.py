"""Young's modulus of a layer is converted to the shear modulus where it enters: μ = E/3."""

import math

import pytest

from flexneedle.errors import ScenarioError
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.model import Scenario

PHANTOM = load_scenario("phantom")
YOUNG, SHEAR = "youngs_modulus_kpa", "shear_modulus_kpa"


def with_layer(**changes):
    """Return the phantom with changes of its second layer; None takes a key out."""
    values = PHANTOM.values()
    layer = values["tissue"][1] | changes
    values["tissue"][1] = {key: value for key, value in layer.items() if value is not None}
    return Scenario.from_values(values)


@pytest.mark.parametrize("law", [{}, {"law": "linear", "alpha": None}])
def test_a_layer_takes_youngs_modulus_instead_of_the_shear_modulus(law):
    scenario = with_layer(**{SHEAR: None, YOUNG: 12.0}, **law)
    assert scenario.tissue[1].shear_modulus_kpa == pytest.approx(4.0)
    assert scenario.tissue[1].modulus == pytest.approx(0.012)  # MPa: E itself, of a free compression
    assert scenario == with_layer(**{SHEAR: 4.0}, **law)
    assert (YOUNG in dump_scenario(scenario), SHEAR in dump_scenario(scenario)) == (False, True)


def test_a_change_of_youngs_modulus_replaces_the_shear_modulus():
    for key in (f"tissue.0.{YOUNG}", f"tissue[0].{YOUNG}"):
        assert PHANTOM.with_values({key: 6}).tissue[0].shear_modulus_kpa == pytest.approx(2.0)
    both = {f"tissue.0.{YOUNG}": 6.0, f"tissue.0.{SHEAR}": 2.0}
    with pytest.raises(ScenarioError, match=r"leave it out: shear_modulus_kpa gives it \(E = 3μ\)"):
        PHANTOM.with_values(both)


@pytest.mark.parametrize(
    ("value", "rule"),
    [(0.0, "must be above 0"), (-3, "must be above 0"), ("12", "must be a number"), (True, "must be a number"),
     (math.nan, "must be a finite number"), (1e9, "must be at most 1e+06")],
)  # fmt: skip
def test_youngs_modulus_has_the_rules_of_a_modulus(value, rule):
    with pytest.raises(ScenarioError) as caught:
        with_layer(**{SHEAR: None, YOUNG: value})
    (line,) = caught.value.problems
    assert line.startswith(f"tissue[1].{YOUNG} = ")
    assert line.endswith(rule)


@pytest.mark.parametrize("key", ["young_modulus_kpa", "youngs_modulus_mpa", "youngs_modulus", "modulus_kpa"])
def test_a_misspelt_modulus_gets_both_keys_with_their_factor(key):
    with pytest.raises(ScenarioError) as caught:
        with_layer(**{key: 12.0})
    assert "did you mean shear_modulus_kpa (μ) or youngs_modulus_kpa (E = 3μ)? " in str(caught.value)
