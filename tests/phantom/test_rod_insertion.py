"""Insertions of the exact plant: against the controller's model, a second solver and closed forms; the channel."""

import math
from itertools import pairwise

import numpy as np
import pytest

from reference.rods import IDEAL, Bench, move, plant
from reference.validation import (
    FINE,
    ROUGH,
    SHIPPED,
    SMALL,
    commands,
    curvature_error,
    inserted_tip,
    model_gap,
    order,
    push,
    scaled,
    shot,
    stepped,
    wander,
)

AHEAD, BACK = 0.25, -0.25
START = 114  # steps of 0.25 mm to the skin


def inserted(needle, scale, depth):
    """Insert with the commands of the validation; return the plant."""
    for row in commands(scale, depth, AHEAD):
        needle.step(row)
    return needle


# ---- accuracy


@pytest.mark.long
@pytest.mark.parametrize("layers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_it_agrees_with_the_controllers_model_at_small_angles(layers):
    """Two formulations with the same limit: the distance of the tips is cubic in the angle."""
    meshes = {2.0: SMALL, 1.0: SMALL, 0.5: FINE, 0.25: FINE}
    gaps = [model_gap(scale, layers, **mesh) for scale, mesh in meshes.items()]
    for larger, smaller in pairwise(gaps):
        assert smaller.lateral < larger.lateral / 4.0
    last = gaps[-2:]
    assert order([gap.angle for gap in last], [gap.lateral for gap in last]) == pytest.approx(3.0, abs=0.4)
    assert gaps[0].lateral > 0.1  # at 0.15 rad the error of the linear beam is above 0.1 mm
    assert gaps[-1].lateral < 1e-4
    assert abs(gaps[-1].energy) < 2e-4


def test_the_distance_from_the_controllers_model_decreases_with_the_mesh():
    """At 0.01 rad: 0.3 µm per mm of deflection on the default mesh, less on a finer one."""
    coarse, fine = model_gap(0.25, 2, **SHIPPED), model_gap(0.25, 2, **SMALL)
    assert coarse.lateral < 5e-4
    assert fine.lateral < coarse.lateral / 3.0


def test_a_second_solver_finds_the_same_insertion():
    """Shooting along the continuous rod: all inputs, two layers, clearance, bend, start error, varying stiffness."""
    expected = shot(ROUGH, wander())
    gaps = np.array([np.abs(stepped(ROUGH, wander(), h) - expected).max(axis=0) for h in (1.0, 0.5, 0.25)])
    assert np.ptp(expected[:, 1]) > 1.0
    assert gaps[-1, 0] < 1e-6
    assert gaps[-1, 1] < 2e-5
    assert order((1.0, 0.5, 0.25), gaps[:, 1]) == pytest.approx(2.0, abs=0.25)
    # The last segment has the slope half a segment before the tip; natural curvature makes that first order.
    assert order((1.0, 0.5, 0.25), gaps[:, 2]) == pytest.approx(1.0, abs=0.1)
    assert gaps[-1, 2] < 2e-5


@pytest.mark.long
def test_a_second_solver_finds_the_same_friction():
    """Its direction is the direction of the needle before a step: an error linear in the step."""
    rubbed = ROUGH.with_values({"phantom.friction_mn_per_mm": 50.0})
    ends = [shot(rubbed, push(parts))[-1] for parts in (1, 2)]
    gaps = [abs(stepped(rubbed, push(k), 0.25)[-1, 1] - end[1]) for k, end in zip((1, 2), ends, strict=True)]
    without = abs(stepped(ROUGH, push(2), 0.25)[-1, 1] - ends[1][1])
    assert gaps[1] < 0.6 * gaps[0]
    assert gaps[1] < without / 5.0


@pytest.mark.parametrize("bevel_length", [1.0, 3.0])
def test_steady_curvature_converges_to_its_closed_form(bevel_length):
    """docs/theory.md eq. 10, at a depth of several 1/β and small strain."""
    coarse, fine = (abs(curvature_error(resolution, bevel_length)) for resolution in (1.0, 0.5))
    assert coarse < 0.012
    assert fine < 0.004
    assert fine < coarse / 2.5


@pytest.mark.parametrize(
    ("name", "sizes", "limits", "cell"),
    [
        ("step", (0.5, 0.25, 0.125, 0.0625), (1e-3, 3e-4, 1e-4), {}),
        ("spacing", (1.0, 0.5, 0.25, 0.125), (5e-3, 2e-3, 1e-3), {"cell": 0.125}),
    ],
)
def test_an_insertion_hardly_depends_on_step_and_spacing(name, sizes, limits, cell):
    """Within 0.1 % and 0.5 % of the path's lateral motion (mm), with decreasing differences."""
    tips = np.array([inserted_tip(**{name: size}, **cell)[:2] for size in sizes])
    apart = np.hypot(*(tips[:-1] - tips[-1]).T)
    assert (apart < limits).all()
    assert (np.diff(apart) < 0.0).all()


# ---- entry and exit


def test_an_inclined_needle_cuts_along_its_axis_from_the_skin_on():
    """In one step through the skin: points every 0.5 mm along the needle, the first 0.25 mm behind its entry."""
    turn = 0.2
    bench = Bench(length=60.0, segments=30, base=(-60.0, 0.0, turn)).step().step(db_x=3.0)
    depth = 3.0 - 60.0 * (1.0 - math.cos(turn))
    entry = bench.s["tip"][1] - depth * math.tan(turn)
    along = 0.25 + 0.5 * np.arange(bench.count)
    assert bench.count == 4
    np.testing.assert_allclose(bench.channel["place"][:4, 0], along * math.cos(turn), atol=1e-9)
    np.testing.assert_allclose(bench.channel["place"][:4, 1], entry + along * math.sin(turn), atol=1e-9)
    assert bench.s["cut"] == pytest.approx(depth / math.cos(turn), rel=1e-12)


def test_out_of_the_skin_the_channel_is_closed():
    """The next entry cuts a new channel at the tip."""
    needle = move(plant(), AHEAD, times=START + 40)
    move(needle, BACK, times=44)
    assert needle.tip[0] < 0.0
    assert (needle.count, needle.state["cut"], *needle.state["offset"]) == (0, 0.0, 0.0, 0.0, 0.0)
    assert needle.strain_energy == 0.0
    move(needle, dg_y=0.3, times=4)
    entry = needle.tip[1]
    move(needle, AHEAD, times=12)
    assert needle.channel["place"][0, 1] == pytest.approx(entry, abs=0.1)
    assert entry > 1.0


# ---- the channel


def test_a_flip_without_insertion_changes_only_the_bevel():
    """At rest, during retraction, and twice before a push; for a straight needle."""
    needle, one, other = (move(plant(), AHEAD, times=START + 80) for _ in range(3))
    tip = needle.tip
    np.testing.assert_allclose(move(needle, flip=True).tip, tip, atol=1e-9)
    assert needle.roll == math.pi
    move(needle, flip=True)
    np.testing.assert_allclose(move(one, BACK).tip, move(other, BACK, flip=True).tip, atol=1e-9)
    after = move(plant(), AHEAD, times=START + 100).tip[1]
    assert move(needle, AHEAD, times=20).tip[1] == pytest.approx(after, abs=1e-6)


def test_strain_energy_is_weighted_by_layer_and_counts_contact_points():
    """Without a bevel all energy outside the needle is in them; a weight of 3 on both layers triples the result."""
    weights = {f"tissue.{k}.energy_weight": 3.0 for k in (0, 1)}
    blunt = scaled(0.0, 2, 0.5, 0.5).with_values({"needle.bevel.length_mm": 1e-6})
    one, three = (inserted(plant(each), 1.0, 30.0) for each in (blunt, blunt.with_values(weights)))
    assert one.strain_energy > 1e-3
    assert three.strain_energy == pytest.approx(3.0 * one.strain_energy, rel=1e-12)
    np.testing.assert_array_equal(three.tip, one.tip)
    spans = np.full(len(one.segments) - 1, one.rod.segment)
    spans[0] *= 0.5  # the first is half as long
    bend = (0.5 * (one.segments["moment"][:-1] ** 2).sum(axis=1) * spans).sum() / one.rod.stiffness
    guide = 0.5 * one.state["guide_force"][0] ** 2 / one.rod.guide_stiffness
    assert one.state["energy"] == pytest.approx(one.strain_energy + bend + guide, rel=1e-6)


def test_the_least_stretch_is_at_the_most_compressed_point():
    needle = inserted(plant(), 1.5, 40.0)
    x, y, _ = needle.nodes.T
    points = needle.channel["place"][: needle.count]
    apart = np.abs(np.interp(points[:, 0], x, y) - points[:, 1])
    assert needle.least_stretch == pytest.approx(1.0 - apart.max() / 20.0, abs=1e-3)
    assert needle.least_stretch < 0.99


# ---- limits of the record


def test_a_full_channel_ends_the_cut_and_is_reported():
    """10 mm need twenty points: with fewer the tissue would be incomplete."""
    for room, converged in ((5, False), (40, True)):
        bench = Bench(length=60.0, segments=30, base=(-60.0, 0.0, 0.0), points=room)
        for _ in range(10):
            bench.step(db_x=1.0)
        assert bench.converged == converged
        assert bench.count == min(room, 20)


def test_beyond_the_last_cell_the_tissue_is_that_in_the_last_cell():
    """Cells end 2 mm beyond the stroke; a contact point beyond uses the last cell."""
    needle = plant()
    depth = needle.rod.law.size * needle.rod.cell
    assert depth >= IDEAL.setup.max_depth + 2.0
    needle.state["base"][0] += depth + 27.0
    move(needle, 0.25, times=20)
    assert needle.tip[0] > depth
    assert needle.channel["stiffness"][needle.count - 1] > 0.0
