"""The exact rod in tissue: law, derivatives, forces normal to the needle, friction, channel."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexneedle.mechanics.law import tables
from flexneedle.rig.phantom import rod as rd
from flexneedle.scenario.tissue.ogden import Ogden
from reference.insertion import Tissue, ogden
from reference.rods import IDEAL, Bench, move, plant, uncompiled
from reference.validation import MOVES, bent, energy_balance, friction_balance, insertion_balance

PLAIN = uncompiled(rd)


def ogden_layer(alpha):
    """A layer of this law; stiffness and size are those of a test."""
    return Ogden(alpha=alpha, shear_modulus_kpa=1.0, compression_length_mm=20.0, engaged_width_mm=1.0)


TISSUE = {
    "laws": tables([ogden_layer(alpha) for alpha in (6.0, 8.74, -5.0, 8.0)]),
    "law": np.array([0, 1, 2]),
    "height": np.array([20.0, 15.0, 25.0]),
    "foundation": np.array([0.675, 2.36, 0.27]),
    "weight": np.array([1.0, 2.0, 0.5]),
    "cell": 14.0,
}
SEGMENTS, POINTS = 10, 12
AHEAD, BACK = 0.25, -0.25


@given(
    alpha=st.one_of(st.floats(0.5, 30.0), st.floats(-30.0, -0.5)),
    height=st.floats(5.0, 40.0),
    share=st.floats(-1.2, 1.2),
    modulus=st.floats(1e-4, 0.1),
    volume=st.floats(0.1, 200.0),
)
@settings(deadline=None, derandomize=True, max_examples=300)
def test_the_law_is_that_of_the_equations(alpha, height, share, modulus, volume):
    """Written out as in equations 1 to 3, also beyond the floor stretch; the stiffness as far as a table has it."""
    u, table = share * height, tables([ogden_layer(alpha)])[0]
    f, k, stored, stretch = PLAIN._law(table, height, 3.0 * modulus * volume / height**2, u)
    point = Tissue(*(np.array([value]) for value in (modulus, alpha, height, volume)))
    energy, force, stiffness = (float(values[0]) for values in ogden(point, np.array([u])))
    size = modulus * volume / alpha**2  # 2λ^(−α/2) + λ^α − 3 cancels near 1
    assert f == pytest.approx(-force, rel=1e-9, abs=1e-13 * size / height)
    assert k == pytest.approx(stiffness, rel=1e-7 if alpha < -18.0 else 1e-8)
    assert stored == pytest.approx(energy, rel=1e-9, abs=1e-13 * size)
    assert stretch == 1.0 - abs(u) / height


@pytest.mark.parametrize("u", [-19.0, -15.0, -8.0, -1e-3, 1e-3, 3.0, 13.9, 14.1, 25.0])
def test_force_and_stiffness_are_the_derivatives_of_the_energy(u):
    law = tables([ogden_layer(8.74)])[0], 20.0, 1.5 * 8.74 * 0.8 / 20.0
    (_, _, above, _), (_, _, below, _) = PLAIN._law(*law, u + 1e-5), PLAIN._law(*law, u - 1e-5)
    f, k, _, _ = PLAIN._law(*law, u)
    assert f == pytest.approx((above - below) / 2e-5, rel=1e-6)
    assert k == pytest.approx(
        (PLAIN._law(*law, u + 1e-5)[0] - PLAIN._law(*law, u - 1e-5)[0]) / 2e-5, rel=1e-6
    )


def crooked(seed, *, guide=True, channel=True):
    """A rod bent by up to 1 rad, with channel offsets up to 6 mm, a guide offset of 3 mm, and a retracted tip."""
    rng = np.random.default_rng(seed)
    bench = Bench(
        length=60.0,
        segments=SEGMENTS,
        base=(-30.0, 0.3, 0.2),
        stiffness=300.0,
        curvature=1e-3,
        bevel_offset=2.0,
        bevel_length=3.0,
        guide_x=-11.3 if guide else math.nan,
        clearance=0.05,
        guide_stiffness=3.0,
        friction=0.0,
        **TISSUE,
    )
    bench.theta[:] = 0.2 + np.cumsum(rng.normal(0.0, 0.15, SEGMENTS))
    bench.s[[rd.GUIDE_Y, rd.CURVED]] = 2.0, 1.0
    bench.s[[rd.LOAD_X, rd.LOAD_Y]] = 0.3, -0.2
    PLAIN._update_nodes(bench.rod, bench.s, bench.work, bench.theta)
    nodes, tip = bench.work[[rd.X, rd.Y]].T, bench.s[[rd.TIP_X, rd.TIP_Y, rd.TIP_TURN]]
    if channel:
        x = np.linspace(0.3, tip[0] - 1.0, POINTS)
        bench.count = POINTS
        bench.channel[rd.C_X, :POINTS] = x
        bench.channel[rd.C_Y, :POINTS] = np.interp(x, *nodes.T) + rng.normal(0.0, 3.0, POINTS)
        law = {rd.C_LAW: 3, rd.C_HEIGHT: 20.0, rd.C_STIFFNESS: 0.48, rd.C_WEIGHT: 1.0}
        for row, value in law.items():
            bench.channel[row, :POINTS] = value
    # The front is 5 mm ahead: no bevel here, whose force has no energy.
    bench.s[[rd.CUT, rd.FRONT_X, rd.FRONT_Y, rd.FRONT_TURN]] = 30.0, tip[0] + 5.0, tip[1], tip[2]
    return bench


def assembled(bench, theta):
    """Energy (mJ) minus the work of the load, and its gradient in the angles by the chain rule over the nodes."""
    PLAIN._update_nodes(bench.rod, bench.s, bench.work, theta)
    tip = tuple(bench.s[[rd.TIP_X, rd.TIP_Y, rd.TIP_TURN]])
    PLAIN._assemble(bench.rod, bench.s, bench.work, theta, bench.channel, bench.count, tip)
    w, s = bench.work, bench.s
    behind = np.cumsum(w[[rd.GX, rd.GY]][:, ::-1], axis=1)[:, -2::-1]  # forces on all nodes after a segment
    arms = bench.rod.segment * np.array([-np.sin(theta), np.cos(theta)])
    moment = w[rd.MOMENT, :-1]
    gradient = w[rd.GT, :-1] + (arms * behind).sum(axis=0) + moment - np.append(moment[1:], 0.0)
    return s[rd.ENERGY] - s[rd.LOAD_X] * s[rd.TIP_X] - s[rd.LOAD_Y] * s[rd.TIP_Y], gradient


def differences(function, theta, step=1e-6):
    """Central differences of a function of the angles, one row per angle."""
    shifts = step * np.eye(theta.size)
    return np.array([(function(theta + e) - function(theta - e)) / (2 * step) for e in shifts])


@pytest.mark.parametrize("seed", range(4))
def test_forces_are_the_gradient_of_the_energy(seed):
    """Of needle, guide, tissue and load together, at angles of up to a radian."""
    bench = crooked(seed)
    theta = bench.theta.copy()
    assert np.ptp(theta) > 0.3
    _, gradient = assembled(bench, theta)
    assert abs(bench.s[rd.GUIDE_FORCE]) > 1.0
    found = differences(lambda angles: assembled(bench, angles)[0], theta)
    np.testing.assert_allclose(gradient, found, rtol=1e-6, atol=1e-7 * np.abs(gradient).max())


@pytest.mark.parametrize("seed", range(4))
def test_a_sweep_solves_newtons_equations_with_all_second_derivatives(seed):
    """Its step is −H⁻¹g, with the Hessian from differences of the gradient."""
    bench = crooked(seed)
    theta = bench.theta.copy()
    hessian = differences(lambda angles: assembled(bench, angles)[1], theta)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-5)
    _, gradient = assembled(bench, theta)
    assert PLAIN._sweep(bench.rod, bench.s, bench.work, theta) == (np.linalg.eigvalsh(hessian)[0] > 0.0)
    largest = PLAIN._newton_step(bench.work, SEGMENTS)
    step = bench.work[rd.TRIAL, :SEGMENTS]
    np.testing.assert_allclose(step, -np.linalg.solve(hessian, gradient), rtol=1e-6, atol=1e-8)
    assert PLAIN._slope(bench.work, SEGMENTS) == pytest.approx(step @ gradient, rel=1e-9)
    arms = bench.rod.segment * np.array([-np.sin(theta), np.cos(theta)])
    assert largest == pytest.approx(np.hypot(*np.cumsum(arms * step, axis=1)).max(), rel=1e-9)


def test_without_its_geometric_part_the_hessian_gives_a_descent_direction():
    """At three times Euler's load the full Hessian of a straight rod is indefinite."""
    bench = Bench(length=100.0, segments=SEGMENTS, curvature=1e-3)
    bench.s[rd.LOAD_X] = -3.0 * np.pi**2 * 1000.0 / (4.0 * 100.0**2)
    tip = (-900.0, 0.0, 0.0)
    for curved in (1.0, 0.0):
        bench.s[rd.CURVED] = curved
        PLAIN._update_nodes(bench.rod, bench.s, bench.work, bench.theta)
        PLAIN._assemble(bench.rod, bench.s, bench.work, bench.theta, bench.channel, 0, tip)
        assert PLAIN._sweep(bench.rod, bench.s, bench.work, bench.theta) == (curved == 0.0)
    PLAIN._newton_step(bench.work, SEGMENTS)
    assert PLAIN._slope(bench.work, SEGMENTS) < 0.0


def test_forces_of_tissue_and_guide_are_normal_to_the_needle():
    """On each segment the force has no tangential component."""
    bench = crooked(1)
    bench.s[[rd.LOAD_X, rd.LOAD_Y]] = 0.0
    assembled(bench, bench.theta)
    x, y = bench.work[[rd.GX, rd.GY], :-1]
    assert np.abs(x).max() > 0.1
    np.testing.assert_allclose(x * np.cos(bench.theta) + y * np.sin(bench.theta), 0.0, atol=1e-12)


def test_the_bevels_force_is_normal_to_the_tip():
    """Law of the length in the tissue, ρ = b at the tip during insertion; zero 5 mm behind the front."""
    bench = crooked(2, guide=False, channel=False)
    bench.s[[rd.LOAD_X, rd.LOAD_Y, rd.CUT]] = 0.0
    turn = bench.s[rd.TIP_TURN]
    PLAIN._assemble(bench.rod, bench.s, bench.work, bench.theta, bench.channel, 0, (*bench.s[10:12], turn))
    push = bench.work[[rd.GX, rd.GY], -1]
    depth = bench.s[rd.TIP_X]
    top = depth - 3.0 * np.cos(turn)
    cuts = [*(c for c in (14.0, 28.0) if top < c < depth)]
    assert len(cuts) == 1  # the boundary at 28 mm is within those 3 mm
    expected = 0.0
    for above, below in zip([top, *cuts], [*cuts, depth], strict=True):
        c, length = int(0.5 * (above + below) / 14.0), (below - above) / np.cos(turn)
        table = TISSUE["laws"][TISSUE["law"][c]]
        f, *_ = PLAIN._law(table, TISSUE["height"][c], TISSUE["foundation"][c] * length, -2.0)
        expected += f
    np.testing.assert_allclose(push, expected * np.array([-np.sin(turn), np.cos(turn)]), rtol=1e-9)
    assert expected < 0.0  # gradient: the tissue pushes the tip towards +y
    drawn_back = crooked(2, guide=False, channel=False)
    drawn_back.s[[rd.LOAD_X, rd.LOAD_Y]] = 0.0
    assembled(drawn_back, drawn_back.theta)
    np.testing.assert_array_equal(drawn_back.work[[rd.GX, rd.GY], -1], 0.0)


@pytest.mark.parametrize("name", MOVES)
def test_the_work_of_base_and_guide_is_the_stored_energy(name):
    """Without cutting; the error is quadratic in the step, except where the segment of a contact point changes."""
    gaps = []
    for steps in (10, 20, 40):
        done, stored = energy_balance(name, steps)
        assert abs(stored) > 0.1
        gaps.append(done / stored - 1.0)
    assert abs(gaps[-1]) < 3e-6
    assert gaps[0] / gaps[1] == pytest.approx(4.0, abs=0.3)
    assert abs(gaps[2]) < abs(gaps[1]) / 2.5


def test_energy_is_a_function_of_the_positions_of_base_and_guide():
    """After a closed loop of motions without cutting the needle is the same."""
    needle = bent(3.75)
    before, energy = needle.nodes, needle._s[rd.ENERGY]
    for sign in (1.0, -1.0):
        move(needle, db_y=-0.1 * sign, dg_y=0.1 * sign, times=20)
    np.testing.assert_allclose(needle.nodes, before, atol=2e-5)
    assert needle._s[rd.ENERGY] == pytest.approx(energy, rel=1e-5)


def test_a_push_with_friction_stores_and_dissipates_the_work_of_the_base():
    """3 mm along the channel, with an inserted length of 23 to 26 mm; within 0.1 % of the dissipated energy."""
    done, stored, lost = friction_balance(20)
    assert lost == pytest.approx(0.372, abs=0.001)
    assert stored > 0.01
    assert done == pytest.approx(stored + lost, abs=1.5e-3 * lost)


def test_work_on_an_insertion_is_stored_or_dissipated():
    """With cutting, guide motion and a flip: the difference decreases with the step, to 2e-4 of the work."""
    gaps = [abs(insertion_balance(step, friction=0.0).gap) for step in (0.5, 0.25, 0.125, 0.0625)]
    assert (np.diff(np.log2(gaps)) < -0.75).all()
    assert gaps[-1] < 3e-4
    rubbed = insertion_balance(0.125, friction=5.0)
    assert rubbed.friction > 3.9  # 5 mN/mm over 40 mm
    assert abs(rubbed.gap) < 2e-5
    assert min(rubbed.needle, rubbed.tissue) > 0.01


def test_friction_is_5_mn_per_mm_opposite_to_the_last_sliding_direction():
    """For a straight needle the base force is 5 mN per mm inserted: pushing, resting, pulling."""
    needle = plant(IDEAL.with_values({"needle.bevel.offset_mm": 0.0, "phantom.friction_mn_per_mm": 5.0}))
    move(needle, AHEAD, times=114)
    assert needle._s[rd.BASE_FORCE_X] == 0.0
    for _ in range(8):
        move(needle, AHEAD, times=20)
        assert needle._s[rd.BASE_FORCE_X] == pytest.approx(5e-3 * needle.tip[0], rel=1e-12)
        assert needle._s[rd.BASE_FORCE_Y] == 0.0
    assert needle.tip[0] == pytest.approx(40.0)
    assert move(needle)._s[rd.BASE_FORCE_X] == pytest.approx(5e-3 * 40.0)  # constant at rest
    move(needle, BACK)
    assert needle._s[rd.BASE_FORCE_X] == pytest.approx(-5e-3 * 39.75)
    move(needle, BACK, times=159)
    assert needle._s[rd.BASE_FORCE_X] == pytest.approx(0.0, abs=1e-12)  # the tip is at the skin


def test_friction_follows_the_bent_needle():
    """Its direction is that of each segment, on the part inside the tissue."""
    needle = bent(8.0, friction=5.0)
    move(needle, 0.01)
    fx, fy = needle._work[[rd.FX, rd.FY], :-1]
    inside = np.hypot(fx, fy) / 5e-3
    x = needle.nodes[:, 0]
    assert not inside[x[1:] <= 0.0].any()
    np.testing.assert_allclose(inside[x[:-1] >= 0.0], needle.rod.segment)
    crossing = int(np.flatnonzero(x > 0.0)[0]) - 1
    assert inside[crossing] == pytest.approx(
        needle.rod.segment * x[crossing + 1] / (x[crossing + 1] - x[crossing]), rel=5e-3
    )
    along = fx * np.cos(needle._theta) + fy * np.sin(needle._theta)
    np.testing.assert_allclose(along, -5e-3 * inside, rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_mirrored_commands_give_the_mirrored_needle(seed):
    """Base, guide, bevel, start, bend and random commands mirrored at the axis: to the last bit."""
    rng = np.random.default_rng(seed)
    changes = {
        "phantom.friction_mn_per_mm": 5.0,
        "phantom.guide_clearance_mm": 0.05,
        "setup.tip_to_skin_mm": 2.0,
    }
    rough = IDEAL.with_values(changes)
    one = plant(rough, base_y=0.4, base_turn=0.003, bend=0.5)
    other = plant(rough, bevel=-1, base_y=-0.4, base_turn=-0.003, bend=0.5)
    for _ in range(240):
        ahead = rng.choice([0.25, 0.25, 0.25, 0.1, -0.25])
        lateral, rotation, guide = rng.normal(0.0, [0.02, 2e-4, 0.05])
        flip = rng.choice([1.0, -1.0], p=[0.05, 0.95])
        one.step(np.array([ahead, lateral, rotation, guide, flip]))
        other.step(np.array([ahead, -lateral, -rotation, -guide, flip]))
    assert one.converged
    assert one.tip[0] > 10.0
    assert abs(one.tip[1]) > 0.1
    np.testing.assert_array_equal(other.tip, one.tip * [1.0, -1.0, -1.0])
    np.testing.assert_array_equal(other.nodes, one.nodes * [1.0, -1.0])
    assert (other.strain_energy, other.least_stretch) == (one.strain_energy, one.least_stretch)


def test_a_symmetric_tip_has_a_straight_path():
    """b = 0 without lateral offsets: exactly straight through both layers, without stored energy."""
    needle = move(plant(IDEAL.with_values({"needle.bevel.offset_mm": 0.0})), AHEAD, times=294)
    assert not needle.nodes[:, 1].any()
    assert needle.tip[0] == pytest.approx(45.0, abs=1e-12)
    assert needle.strain_energy == needle._s[rd.ENERGY] == 0.0
    assert needle.least_stretch == 1.0
