"""The exact rod converges for all valid scenarios and commands, and reports failures."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

import flexneedle.rig.phantom
from flexneedle import load_scenario
from flexneedle.rig.phantom import rod as rd
from flexneedle.rig.phantom.draw import draw
from flexneedle.rig.phantom.phantom import Phantom
from reference import draws
from reference.rods import IDEAL, Bench, move, plant

PHANTOM = load_scenario("phantom")
EXTREME = PHANTOM.with_values(
    {
        "phantom.shear_modulus_factor": [0.3, 2.5],
        "phantom.bevel_factor": [0.0, 2.0],
        "phantom.start_offset_sd_mm": 1.0,
        "phantom.start_angle_sd_mrad": 6.0,
        "phantom.shear_modulus_variation": 0.6,
        "phantom.layer_shift_sd_mm": 5.0,
        "phantom.initial_bend_mm": 2.0,
        "phantom.run_out_mm": 1.0,
        "phantom.guide_clearance_mm": 0.2,
        "phantom.friction_mn_per_mm": 20.0,
    }
)


def within(phantom, row):
    """A row (4,) cut to the limits of step and travel."""
    limits, moved = phantom._limits, phantom._moved
    row = np.clip(row, -limits.step, limits.step)
    return np.clip(row, limits.travel[:, 0] - moved, limits.travel[:, 1] - moved)


def wander(scenario, seed, periods):
    """(steps, failed steps) of random commands in all five inputs on a drawn phantom."""
    rng = np.random.default_rng(seed)
    phantom = Phantom(draw(scenario, rng), 1)
    inner, steps, lost = phantom._plant, 0, 0
    forward, drift = rng.uniform(0.6, 1.0), rng.normal(0.0, 0.2)

    def counted(row, step=inner.step):
        nonlocal steps, lost
        step(row)
        steps += 1
        lost += inner._s[rd.CONVERGED] == 0.0
        assert np.isfinite(inner._s).all()

    inner.step = counted
    for _ in range(periods):
        ahead = rng.uniform(0.0, 1.0) * (1.0 if rng.random() < forward else -1.0)
        lateral, rotation, guide = (
            rng.uniform(-0.2, 0.2),
            rng.uniform(-2e-3, 2e-3),
            drift + rng.normal(0.0, 0.2),
        )
        row = within(phantom, np.array([ahead, lateral, rotation, guide]))
        phantom.apply((*row.tolist(), 1 if rng.random() < 0.1 else -1), 0.2)
    assert phantom.condition().converged == (lost == 0)
    return steps, lost


@pytest.mark.long
def test_ten_thousand_random_steps_of_extreme_phantoms_converge():
    """Tissue × 0.3 to 2.5, bevel × 0 to 2, at least twice the default imperfections; any position of guide and base."""
    counts = np.array([wander(EXTREME, seed, 80) for seed in range(52)]).sum(axis=0)
    assert counts[0] > 10_000
    assert counts[1] == 0


def test_random_scenarios_converge():
    """One to three layers of fat to muscle, 18 to 23 gauge, with and without a guide."""
    counts = np.zeros(2, dtype=int)
    for seed in range(12):
        counts += wander(draws.draw_scenario(np.random.default_rng(seed)), seed, 60)
    assert counts[0] > 1000
    assert counts[1] == 0


def test_a_failed_equilibrium_is_reported_permanently():
    """A straight column under three times Euler's load is an unstable equilibrium."""
    bench = Bench(segments=32).loaded(x=-3.0 * math.pi**2 * 1000.0 / (4.0 * 100.0**2))
    assert not bench.converged
    needle = plant()
    needle._s[rd.LOAD_X] = -100.0
    needle.step(np.array([0.0, 0.0, 0.0, 0.0, -1.0]))
    assert not needle.converged
    needle._s[rd.LOAD_X] = 0.0
    needle.step(np.array([0.0, 0.0, 0.0, 0.0, -1.0]))
    assert needle._s[rd.CONVERGED] == 1.0
    assert not needle.converged  # permanently


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("where", ["angle", "base", "guide", "load", "contact"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_invalid_numbers_are_reported_and_the_solve_ends(where, bad):
    """No endless loop, no crash; the failure is reported."""
    needle = move(plant(), 0.25, times=140)
    places = {"base": rd.BASE_Y, "guide": rd.GUIDE_Y, "load": rd.LOAD_Y}
    if where == "angle":
        needle._theta[3] = bad
    elif where == "contact":
        needle._channel[rd.C_Y, 2] = bad
    else:
        needle._s[places[where]] = bad
    for _ in range(3):
        needle.step(np.array([0.25, 0.0, 0.0, 0.0, -1.0]))
    assert not needle.converged or np.isfinite(needle._s).all()
    if math.isnan(bad):
        assert not needle.converged


def test_a_full_channel_ends_the_cut_and_not_the_program():
    bench = Bench(length=60.0, segments=30, base=(-60.0, 0.0, 0.0))
    bench.channel = np.zeros((rd.CHANNEL_ROWS, 5))
    for _ in range(10):
        bench.step(db_x=1.0)
    assert bench.count == 5
    assert not bench.converged  # incomplete tissue


def test_beyond_the_last_cell_the_tissue_is_that_of_the_last_cell():
    """Cells end 2 mm beyond the stroke; a contact point beyond uses the last cell."""
    needle = plant()
    depth = needle.rod.law.size * needle.rod.cell
    assert depth >= IDEAL.setup.max_depth + 2.0
    needle._s[rd.BASE_X] += depth + 27.0
    move(needle, 0.25, times=20)
    assert needle.tip[0] > depth
    assert needle._channel[rd.C_STIFFNESS, needle._count - 1] > 0.0


def imports(path):
    """(module, name) of all imports of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    plain = [
        (alias.name, "") for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
    ]
    named = [
        (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    return plain + named


def test_the_rod_shares_no_solver_with_the_controllers_model():
    """From the package it imports only the two decorators for compilation, and the tables of the tissue's laws."""
    path = Path(flexneedle.rig.phantom.__file__).with_name("rod.py")
    ours = {pair for pair in imports(path) if pair[0].startswith("flexneedle")}
    assert ours == {
        ("flexneedle.mechanics.compile", "inner"),
        ("flexneedle.mechanics.compile", "kernel"),
        ("flexneedle.mechanics.law", "response"),
        ("flexneedle.mechanics.law", "stored_energy"),
    }
    assert {module for module, _ in imports(path)} - {module for module, _ in ours} == {
        "math",
        "typing",
        "numpy",
        "numpy.typing",
    }


def test_the_exact_plant_imports_from_mechanics_only_the_tables_of_the_laws():
    path = Path(flexneedle.rig.phantom.__file__).with_name("plants.py")
    ours = {pair for pair in imports(path) if pair[0].startswith("flexneedle.mechanics")}
    assert ours == {("flexneedle.mechanics.law", "tables")}
