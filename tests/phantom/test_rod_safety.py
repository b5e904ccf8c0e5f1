"""The exact rod converges for all valid scenarios and commands, and reports failures."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

import flexneedle.phantom
from flexneedle import Control, load_scenario
from flexneedle.phantom import rod as rd
from flexneedle.phantom.draw import draw
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import ExactPlant
from flexneedle.simulator.control import MOVES
from flexneedle.types import STILL
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
    """A control cut to the limits of step and travel."""
    limits, moved = phantom._limits, phantom._moved
    row = np.clip(row[:MOVES], -limits.step, limits.step)
    return np.clip(row, limits.travel[:, 0] - moved, limits.travel[:, 1] - moved).tolist()


def wander(scenario, seed, periods):
    """(steps, failed steps) of random commands in all five inputs on a drawn phantom."""
    rng = np.random.default_rng(seed)
    phantom = Phantom(draw(scenario, rng), 0.0)
    inner, steps, lost = phantom._plant, 0, 0
    forward, drift = rng.uniform(0.6, 1.0), rng.normal(0.0, 0.2)

    def counted(row, step=inner.step):
        nonlocal steps, lost
        step(row)
        steps += 1
        lost += inner.state["converged"] == 0.0
        assert np.isfinite([*inner.nodes.ravel(), *inner.state["offset"], inner.state["energy"]]).all()

    inner.step = counted
    for _ in range(periods):
        ahead = rng.uniform(0.0, 1.0) * (1.0 if rng.random() < forward else -1.0)
        lateral, rotation, guide = (
            rng.uniform(-0.2, 0.2),
            rng.uniform(-2e-3, 2e-3),
            drift + rng.normal(0.0, 0.2),
        )
        row = within(phantom, np.array(Control(ahead, db_y=lateral, db_theta=rotation, dg_y=guide)))
        phantom.apply(Control(*row, flip=bool(rng.random() < 0.1)), 0.2)
    assert phantom.condition().converged == (lost == 0)
    return steps, lost


@pytest.mark.slow
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


@pytest.mark.parametrize("seed", range(3))
def test_a_needle_slides_round_the_wall_of_its_guide_in_few_iterations(seed):
    """The preset in space, with a clearance of 0.05 mm: rolls of a bent needle by any angle, the guide in both axes."""
    rng = np.random.default_rng(seed)
    needle = ExactPlant(draw(PHANTOM.with_values({"setup.axes": 2}), rng), 0.0)
    iterations = []
    for _ in range(250):
        roll = rng.uniform(-3.0, 3.0) if rng.random() < 0.1 else 0.0
        across = rng.normal(0.0, 0.03, 2)
        needle.step(np.array(Control(db_x=0.25, dg_y=across[0], dg_z=across[1], roll=roll)))
        iterations.append(needle.state["iterations"])
    assert needle.converged
    assert np.mean(iterations) < 8.0


def test_a_failed_equilibrium_is_reported_permanently():
    """A straight column under three times Euler's load is an unstable equilibrium."""
    bench = Bench(segments=32).loaded(x=-3.0 * math.pi**2 * 1000.0 / (4.0 * 100.0**2))
    assert not bench.converged
    needle = plant()
    needle.state["load"][0] = -100.0
    needle.step(np.array(STILL))
    assert not needle.converged
    needle.state["load"][0] = 0.0
    needle.step(np.array(STILL))
    assert needle.state["converged"] == 1.0
    assert not needle.converged  # permanently


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("where", ["angle", "base", "guide", "load", "contact"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_invalid_numbers_are_reported_and_the_solve_ends(where, bad):
    """No endless loop, no crash; the failure is reported."""
    needle = move(plant(), 0.25, times=140)
    if where == "angle":
        needle.segments["frame"][3, 3] = bad
    elif where == "contact":
        needle.channel["place"][2, 1] = bad
    else:
        needle.state[where][0 if where == "guide" else 1] = bad
    for _ in range(3):
        needle.step(np.array(Control(db_x=0.25)))
    assert not needle.converged or np.isfinite(needle.nodes).all()
    if math.isnan(bad):
        assert not needle.converged


def test_a_full_channel_ends_the_cut_and_not_the_program():
    bench = Bench(length=60.0, segments=30, base=(-60.0, 0.0, 0.0))
    bench.channel = np.zeros(5, rd.POINT)
    for _ in range(10):
        bench.step(db_x=1.0)
    assert bench.count == 5
    assert not bench.converged  # incomplete tissue


def test_beyond_the_last_cell_the_tissue_is_that_of_the_last_cell():
    """Cells end 2 mm beyond the stroke; a contact point beyond uses the last cell."""
    needle = plant()
    depth = needle.rod.law.size * needle.rod.cell
    assert depth >= IDEAL.setup.max_depth + 2.0
    needle.state["base"][0] += depth + 27.0
    move(needle, 0.25, times=20)
    assert needle.tip[0] > depth
    assert needle.channel["stiffness"][needle.count - 1] > 0.0


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


KERNELS = ("space.py", "rod.py", "hinges.py", "loads.py", "sweep.py", "equilibrium.py")


@pytest.mark.parametrize("name", KERNELS)
def test_the_rod_shares_no_solver_with_the_controllers_model(name):
    """Only the two decorators for compilation, the tables of the tissue's laws, and the columns of a control."""
    found = imports(Path(flexneedle.phantom.__file__).with_name(name))
    modules = {module for module, _ in found if module.startswith("flexneedle")}
    ours = {f"flexneedle.phantom.{Path(kernels).stem}" for kernels in KERNELS}
    assert modules - ours <= {"flexneedle.mechanics.compile", "flexneedle.mechanics.law", "flexneedle.types"}
    names = {name for module, name in found if module.startswith("flexneedle.mechanics")}
    assert names <= {"inner", "kernel", "response", "stored_energy"}
    assert {module for module, _ in found} - modules <= {"math", "typing", "numpy", "numpy.typing"}


def test_the_exact_plant_imports_from_mechanics_only_the_tables_of_the_laws():
    path = Path(flexneedle.phantom.__file__).with_name("plants.py")
    ours = {pair for pair in imports(path) if pair[0].startswith("flexneedle.mechanics")}
    assert ours == {("flexneedle.mechanics.law", "tables")}
