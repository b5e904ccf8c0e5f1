"""The needle in space: equal to the needle of the plane in any one plane; rolls, spins, clearance, work and energy."""

import cmath
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from flexneedle import Simulator, controls, load_scenario
from flexneedle.mechanics import lateral as lt
from flexneedle.mechanics import needle as nd
from flexneedle.mechanics import spring
from flexneedle.types import THETA, X, Y, across
from reference.cases import long_beam, numbers
from reference.draws import draw_controls, draw_scenario
from reference.space_insertions import turned

PHANTOM = load_scenario("phantom")
seeds = st.integers(0, 10**6)
angles = st.floats(-math.pi, math.pi)
OUT_OF_PLANE = [2, 4]  # columns of a tip


class Imposed(NamedTuple):
    """Roll (rad) and boundary conditions of the needle at the start: lateral numbers y + iz in mm, rad and N."""

    roll: float = 0.0
    base: complex = 0.0
    slope: complex = 0.0
    guide: complex = 0.0
    load: complex = 0.0

    def turned(self, angle):
        """Return the conditions turned about the axis (rad)."""
        return Imposed(self.roll + angle, *(cmath.exp(1j * angle) * part for part in self[1:]))


def exact(scenario=PHANTOM, axes=2, **constants):
    """Return a simulator with other constants, which solves nearer to equilibrium than usual."""
    scenario = scenario.with_values({"setup.axes": axes})
    model = Simulator(scenario, 1).model._replace(**{"slide": 1e-10, "tolerance": 1e-11, **constants})
    return Simulator(scenario, 1, constants=model)


def commands(count, advance=0.0, *, base=0.0, slope=0.0, guide=0.0, **rolls):
    """Return commands (count, 9) of numbers, or of arrays (count,); base, slope and guide y + iz."""
    columns = {"db_y": base, "db_theta": slope, "dg_y": guide}
    real = {name: np.real(value) for name, value in columns.items()}
    columns = {"db_z": base, "db_psi": slope, "dg_z": guide}
    return controls(count, db_x=advance, **real, **{k: np.imag(v) for k, v in columns.items()}, **rolls)


def started(simulator, imposed):
    """Return the state at the start under imposed conditions."""
    base, slope, load = ((z.real, z.imag) for z in map(complex, (imposed.base, imposed.slope, imposed.load)))
    state = simulator.start(imposed.roll).with_estimate(base=base, slope=slope, tip_load=load)
    return simulator.replay(state, commands(1, guide=imposed.guide))[0]


UNLOADED = Imposed()


def inserted(simulator, rows, imposed=UNLOADED):
    """Return the state after commands (m, 9), and the tips (m, 5) on the way."""
    return simulator.replay(started(simulator, imposed), rows)


def forces(state):
    """Return the forces (N) and the moment (N·mm), y + iz (3,), that hold base, base slope and guide."""
    return np.array([complex(*pair) for pair in state.reactions[:3]])


def drawn(seed, steps=60):
    """Return a random scenario, and random commands in one plane with flips."""
    rng = np.random.default_rng(seed)
    scenario = draw_scenario(rng)
    return scenario, draw_controls(scenario, steps, rng)


def random_in_space(seed, steps=60):
    """Return a random simulator, imposed conditions and commands in no common plane."""
    scenario, rows = drawn(seed, steps)
    guided, rng = scenario.setup.has_guide, np.random.default_rng((seed, 1))
    base, slope, guide, load = np.exp(1j * rng.uniform(-np.pi, np.pi, 4)) * [0.3, 2e-3, 0.4, 2e-3]
    other = drawn(seed + 1, steps)[1] if guided else 0.5 * rows
    for y, z in ((1, 2), (3, 4), (5, 6)):
        rows[:, z] = other[::-1, y]
    if not guided:
        guide, base, rows[:, 5:7] = 0.0, 0.2 * base, 0.0
    rows[:, 7] = rng.choice([0.0, 0.0, 1.0], steps) * rng.uniform(-4.0, 4.0, steps)
    rows[:, 8] = rng.choice([0.0, 0.0, 1.0], steps) * rng.uniform(-9.0, 9.0, steps)
    return exact(scenario), Imposed(rng.uniform(-np.pi, np.pi), base, slope, guide, load), rows


# ---- lateral numbers


@given(z=st.complex_numbers(max_magnitude=1e3), quarters=st.integers(-9, 9))
def test_a_turn_by_whole_quarters_is_exact(z, quarters):
    """To the last bit, although the angle as a float is not exactly a quarter."""
    expected = z * (1.0, 1j, -1.0, -1j)[quarters % 4]
    assert lt.rotate(quarters * 0.5 * math.pi, z) == expected


@given(
    direction=angles, z=st.complex_numbers(max_magnitude=1e3), radial=st.floats(0.0, 9.0), across=st.floats(0.0, 9.0)
)  # fmt: skip
def test_a_stretch_has_two_factors(direction, z, radial, across):
    """The matrix radial·nnᵀ + across·(1 − nnᵀ)."""
    n = np.array([math.cos(direction), math.sin(direction)])
    matrix = radial * np.outer(n, n) + across * (np.eye(2) - np.outer(n, n))
    found = lt.stretch(complex(*n), z, radial, across)
    np.testing.assert_allclose([found.real, found.imag], matrix @ [z.real, z.imag], atol=1e-9)
    assert lt.stretch(1.0, 2.5, radial, across) == radial * 2.5


@given(a=st.complex_numbers(max_magnitude=1e3), b=st.complex_numbers(max_magnitude=1e3))
def test_products_and_sizes_agree_with_vectors(a, b):
    assert lt.dot(a, b) == pytest.approx((a * b.conjugate()).real, rel=1e-12, abs=1e-9)
    assert lt.square(a) == lt.dot(a, a)
    assert lt.size(a) == pytest.approx(abs(a), rel=1e-12, abs=1e-150)
    assert (lt.size(-3.0), lt.square(-3.0), lt.dot(-3.0, 2.0)) == (3.0, 9.0, -6.0)


@pytest.mark.parametrize("spin", [0.0, 0.4, -2.0, 12.0])
def test_the_spring_of_a_spinning_bevel_solves_its_equation(spin):
    """ℓ q′ = b e^{iφ} − q along a step of 2.3 mm, with the bevel turning evenly and ending at its direction."""
    model = exact().model
    length, offset, step = model.bevel_length, model.bevel_offset, 2.3
    bevel, q0 = cmath.exp(0.7j), 0.3 - 1.1j
    tip, channel = nd.NodePose(10.0, 0j, 0j), nd.CutChannel(10.0, q0)
    cut = nd.Cut(tip, channel, spin)
    w = SimpleNamespace(constants=model)
    found, slope = spring.spring_rest.py_func(w, bevel, cut, nd.Path(1.0, 0j), 10.0 + step)

    def rate(x, q):
        return (offset * bevel * np.exp(1j * spin * (x / step - 1.0)) - q) / length

    expected = solve_ivp(rate, (0.0, step), [q0], rtol=1e-11, atol=1e-12).y[0, -1]
    assert found == pytest.approx(expected, abs=1e-9)
    assert slope == pytest.approx(length / step * (1.0 - math.exp(-step / length)))


# ---- one plane, and any other


@settings(max_examples=8)
@given(seed=seeds)
def test_in_one_plane_it_is_the_needle_of_the_plane(seed):
    """Random insertions, to 1e-9 mm, with no motion at all out of that plane."""
    scenario, rows = drawn(seed)
    imposed = Imposed(0.0, 0.2, 1e-3, 0.1 if scenario.setup.has_guide else 0.0, 1e-3)
    (plane, tips), (space, there) = (inserted(exact(scenario, axes), rows, imposed) for axes in (1, 2))
    np.testing.assert_allclose(there, tips, atol=1e-9)
    assert not there[:, OUT_OF_PLANE].any()
    assert not space.rest.imag.any()
    np.testing.assert_allclose(space.rest.real, plane.rest, atol=1e-9)
    assert space.energy == pytest.approx(plane.energy, rel=1e-7, abs=1e-12)
    assert space.strain_energy == pytest.approx(plane.strain_energy, rel=1e-7, abs=1e-12)
    assert space.converged


@settings(max_examples=8)
@given(seed=seeds, angle=angles)
def test_turning_all_inputs_turns_the_needle(seed, angle):
    """Base, guide, bevel, load and every command, in random insertions with rolls and spins."""
    simulator, imposed, rows = random_in_space(seed)
    turn = cmath.exp(1j * angle)
    one, tips = inserted(simulator, rows, imposed)
    other, there = inserted(simulator, turned(rows, angle), imposed.turned(angle))
    assert one.converged
    assert np.abs(tips[:, 2]).max() > 1e-4
    np.testing.assert_allclose(there[:, X], tips[:, X], atol=1e-9)
    np.testing.assert_allclose(across(there, Y), turn * across(tips, Y), atol=1e-9)
    np.testing.assert_allclose(across(there, THETA), turn * across(tips, THETA), atol=1e-10)
    np.testing.assert_allclose(other.rest, turn * one.rest, atol=1e-9)
    assert other.energy == pytest.approx(one.energy, rel=1e-7)


@settings(max_examples=5)
@given(seed=seeds)
def test_mirrored_inputs_mirror_the_needle(seed):
    """z → −z with opposite rolls and spins."""
    simulator, imposed, rows = random_in_space(seed)
    mirrored = rows * [1, 1, -1, 1, -1, 1, -1, -1, -1]
    _, tips = inserted(simulator, rows, imposed)
    _, there = inserted(simulator, mirrored, Imposed(-imposed.roll, *np.conj(imposed[1:])))
    np.testing.assert_allclose(there * [1, 1, -1, 1, -1], tips, atol=1e-10)


@settings(max_examples=6)
@given(angle=angles, bend=st.floats(-1.0, 1.0))
def test_a_bent_needle_with_clearance_turns_as_well(angle, bend):
    """Natural bend and the circle of the guide."""
    simulator = exact(curvature=complex(2.0 * bend / 150.0**2), clearance=0.08)
    rows = commands(50, 1.0, guide=0.06 * np.exp(0.3j * np.arange(50)), spin=0.05)
    imposed = Imposed(roll=0.5 * math.pi, base=0.2)
    tips = [inserted(simulator, turned(rows, by), imposed.turned(by))[1] for by in (0.0, angle)]
    np.testing.assert_allclose(across(tips[1], Y), cmath.exp(1j * angle) * across(tips[0], Y), atol=1e-6)


# ---- rolls and spins


def test_a_roll_by_half_a_turn_is_the_flip():
    """To the last bit: π, −π, 3π, or the bevel's direction reversed by hand; four quarters are none."""
    simulator, on, before = exact(), commands(20, 1.0), commands(48, 1.0, guide=0.03)
    begun, _ = inserted(simulator, before)
    boundary = begun.needle.boundary
    reversed_ = begun.needle._replace(boundary=boundary._replace(bevel=-boundary.bevel))
    _, expected = simulator.replay(replace(begun, solved=begun.solved.with_needle(reversed_)), on)
    flip = on.copy()
    flip[0, 7] = math.pi
    _, planar = inserted(exact(axes=1), np.vstack([before, flip]))
    for half in (1, -1, 3):
        after, tips = simulator.replay(begun, flip * [1, 1, 1, 1, 1, 1, 1, half, 1])
        assert after.needle.boundary.bevel == -1.0
        np.testing.assert_array_equal(tips, expected)
        assert not tips[:, OUT_OF_PLANE].any()
        np.testing.assert_allclose(tips, planar[48:], atol=1e-9)
    rolled, still = (simulator.replay(begun, commands(4, roll=roll))[0] for roll in (0.5 * math.pi, 0.0))
    np.testing.assert_array_equal(numbers(rolled), numbers(still))


def pushed(steps, depth=45.0, turns=0.0, scenario=PHANTOM):
    """Return the tips of an insertion to a depth (mm) in even steps, with an even spin of some turns from the start."""
    way = depth - scenario.setup.start_tip_x
    rows = commands(steps, way / steps, spin=2.0 * math.pi * turns / steps)
    return inserted(exact(scenario), rows)[1]


@pytest.mark.parametrize("turns", [0.5, -7.0])
def test_a_spin_does_not_depend_on_the_steps(turns):
    """The same total spin in 37, 148 and 444 steps: the tip to 5 µm."""
    ends = [across(pushed(steps, turns=turns), Y)[-1] for steps in (37, 148, 444)]
    assert np.abs(np.subtract(ends, ends[-1])).max() < 5e-3
    assert abs(ends[-1]) > 5e-3


def test_a_steady_spin_is_a_helix():
    """Its curvature turns at the rate of the spin, and keeps its size; 1/β is 10 mm."""
    depth, step, rate = 250.0, 1.0, -2 * math.pi / 40.0
    scenario = long_beam(depth, spacing=1.0, bevel=0.01, bevel_length=3.0)
    turns = rate * (depth - scenario.setup.start_tip_x) / (2 * math.pi)
    tips = pushed(int(depth - scenario.setup.start_tip_x), depth, turns, scenario)
    deep = tips[:, X] > 150.0
    x, curvature = tips[deep, X][1:-1], np.diff(across(tips[deep], Y), 2) / step**2
    phase = np.unwrap(np.angle(curvature))
    slope, offset = np.polyfit(x, phase, 1)
    assert slope == pytest.approx(rate, rel=2e-3)
    np.testing.assert_allclose(phase, slope * x + offset, atol=0.05)
    np.testing.assert_allclose(np.abs(curvature), np.abs(curvature).mean(), rtol=0.05)


# ---- the guide's clearance


@settings(max_examples=6)
@given(seed=seeds, clearance=st.floats(1e-2, 0.4))
def test_the_circle_of_a_guide_pushes_towards_its_middle(seed, clearance):
    """The needle is within the circle, and pushed only where it touches it, without a part along the circle."""
    rng = np.random.default_rng(seed)
    way, guide = np.cumsum(rng.normal(0.0, 0.1, 40)), rng.normal(0.0, 0.08, (2, 40))
    simulator, touched = exact(clearance=clearance), set()
    state = started(simulator, Imposed(base=0.3j, slope=1e-3))
    for row in commands(40, 1.0, guide=guide[0] + 1j * guide[1], spin=way):
        state, _ = simulator.replay(state, row[None])
        at_guide = state.mesh["x"] == PHANTOM.setup.guide_x
        place = state.mesh["y"][at_guide][0] - state.needle.boundary.guide
        push = forces(state)[2] * np.conj(place)
        assert state.converged
        assert abs(place) <= clearance + 1e-9
        touches = abs(place) > clearance - 1e-9
        touched.add(touches)
        if touches:
            assert push.real <= 1e-9
            assert abs(push.imag) <= 1e-6 * abs(forces(state)[2])
        else:
            assert forces(state)[2] == 0.0
    assert True in touched


# ---- work and energy


MOVES = {
    "base": (1.4 - 1.2j, 0.0, 0.0),
    "slope": (0.0, 0.012j + 0.008, 0.0),
    "guide": (0.0, 0.0, -1.2 + 1.5j),
    "all": (1.0j, -0.01, 1.1 - 0.9j),
}


@pytest.mark.parametrize("name", MOVES)
def test_work_of_base_and_guide_is_the_energy_stored(name):
    """Trapezoid rule, y and z of all motions, of a needle drawn back: without its spring, its tip past whole points."""
    simulator, rows = exact(), commands(58, 1.0, guide=0.02 - 0.03j)
    rows[45, 7] = 1.1
    state, _ = simulator.replay(inserted(simulator, rows)[0], commands(10, -0.33))
    move = np.array(MOVES[name]) / 60
    energy, work, row = state.energy, 0.0, commands(1, base=move[0], slope=move[1], guide=move[2])
    for _ in range(60):
        before = forces(state)
        state, _ = simulator.replay(state, row)
        work += (0.5 * (before + forces(state)) * np.conj(move)).real.sum()
    assert state.tip[0] < state.needle.channel.front
    assert abs(state.energy - energy) > 5e-3
    assert work == pytest.approx(state.energy - energy, rel=1e-5)


@pytest.mark.parametrize(("alpha", "modulus_kpa"), [(-47.0, 2.0), (80.0, 100.0)])
def test_steep_laws_converge_in_every_direction(alpha, modulus_kpa):
    """A bevel of 13 mm that spins, with the guide going round: to the usual tolerance, and turned with all inputs."""
    layer = {"alpha": alpha, "shear_modulus_kpa": modulus_kpa}
    steep = {f"tissue.{i}.{key}": value for i in (0, 1) for key, value in layer.items()}
    scenario = PHANTOM.with_values({"needle.bevel.offset_mm": 13.0, **steep})
    simulator, ends = exact(scenario, slide=2e-5, tolerance=1e-7), []
    rows = commands(70, 1.0, guide=0.2 * np.exp(0.4j * np.arange(70)), spin=0.3)
    for angle in (0.0, 1.3):
        found = simulator.rollout(simulator.start(angle), turned(rows, angle)[None], limits=False)
        assert found.converged.all()
        ends.append(across(found.tips[0], Y)[-1])
    assert ends[1] == pytest.approx(ends[0] * cmath.exp(1.3j), abs=1e-5)
