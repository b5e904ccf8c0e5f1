"""The exact rod reports failures, and shares no solver with the controller's model."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

import flexneedle.phantom
from flexneedle import Control, load_scenario
from flexneedle.phantom.draw import draw
from flexneedle.phantom.plants import ExactPlant
from reference.rods import IDEAL, move, plant

COARSE = IDEAL.with_values({"phantom.element_mm": 5.0, "phantom.contact_spacing_mm": 1.0})


def test_a_needle_slides_round_the_wall_of_its_guide_in_few_iterations():
    """The preset in space, with a clearance of 0.05 mm: rolls of a bent needle by any angle, the guide in both axes."""
    rng = np.random.default_rng(0)
    scenario = load_scenario("phantom").with_values({"setup.axes": 2})
    needle, iterations = ExactPlant(draw(scenario, rng), 0.0), []
    for _ in range(250):
        roll = rng.uniform(-3.0, 3.0) if rng.random() < 0.1 else 0.0
        across = rng.normal(0.0, 0.03, 2)
        needle.step(np.array(Control(db_x=0.25, dg_y=across[0], dg_z=across[1], roll=roll)))
        iterations.append(needle.state["iterations"])
    assert needle.converged
    assert np.mean(iterations) < 8.0


@pytest.mark.parametrize(
    ("where", "bad"),
    [
        *((where, math.nan) for where in ("angle", "base", "guide", "load", "contact")),
        ("base", math.inf),
        ("contact", -math.inf),
        ("load", 1e300),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_invalid_numbers_are_reported_and_the_solve_ends(where, bad):
    """No endless loop, no crash; the failure is reported."""
    needle = move(plant(COARSE), 0.25, times=140)
    if where == "angle":
        needle.segments["frame"][3, 3] = bad
    elif where == "contact":
        needle.channel["place"][2, 1] = bad
    else:
        needle.state[where][0 if where == "guide" else 1] = bad
    for _ in range(2):
        needle.step(np.array(Control(db_x=0.25)))
    assert not needle.converged or np.isfinite(needle.nodes).all()
    if math.isnan(bad):
        assert not needle.converged


def test_the_exact_rod_shares_no_solver_with_the_controllers_model():
    """Only the decorators for compilation, the tables of the tissue's laws, and the columns of a control."""
    kernels = ("space", "rod", "loads", "sweep", "equilibrium")
    ours = {f"flexneedle.phantom.{name}" for name in kernels}
    for name in (*kernels, "plants"):
        tree = ast.parse(
            Path(flexneedle.phantom.__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
        )
        named = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        mechanics = {one.name for node in named if "mechanics" in node.module for one in node.names}
        if name == "plants":
            assert mechanics == {"tables"}
            continue
        assert mechanics <= {"inner", "kernel", "shared", "response", "stored_energy", "CELLS", "PER_UNIT"}
        others = {node.module for node in named} - ours - {"typing", "numpy.typing"}
        assert others <= {"flexneedle.mechanics.compile", "flexneedle.mechanics.law", "flexneedle.types"}
        plain = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
        assert {one.name for node in plain for one in node.names} <= {"math", "numpy"}
