"""The virtual phantom with both plants: commands, time, agreement and failures."""

import math

import numpy as np
import pytest

from flexneedle import Control
from flexneedle.errors import CommandError, InputError
from flexneedle.phantom.draw import Truth, draw
from flexneedle.phantom.phantom import Phantom, evenly_spaced
from flexneedle.phantom.plants import DEFAULT_PLANT, PLANTS, make_plant
from flexneedle.types import THETA
from phantoms import AHEAD, PHANTOM, SKIN, STRAIGHT, both_plants, driven, make_phantom, tip
from reference.rods import IDEAL

# ---- commands and time


@both_plants
def test_a_command_is_executed_in_finer_steps(kind):
    """One roll of the bevel, to and fro, then 1 mm in four equal parts; all columns of travel."""
    phantom = make_phantom(kind=kind)
    by_hand = make_plant(kind, Truth(IDEAL), 0.0)
    flipped = Control(1.0, db_y=0.01, db_theta=2e-4, dg_y=0.1, flip=True)
    for number in range(32):
        roll = (-1) ** number * math.pi
        assert phantom.apply(flipped, 0.2).control == flipped._replace(roll=roll)
        by_hand.step(np.array(Control(roll=roll)))
        for _ in range(4):
            by_hand.step(np.array(flipped._replace(roll=0.0)) / 4.0)
    np.testing.assert_array_equal(tip(phantom), by_hand.tip)
    assert phantom.condition().strain_energy == by_hand.strain_energy > 0.0


@pytest.mark.parametrize(
    ("advance", "parts"), [(0.0, 1), (0.25, 1), (0.26, 2), (0.75, 3), (1.0, 4), (-1.0, 4)]
)
def test_parts_are_no_longer_than_the_step_of_the_phantom(advance, parts):
    phantom = driven(make_phantom(), STRAIGHT)
    advances, step = [], phantom._plant.step
    phantom._plant.step = lambda row: advances.append(row[0]) or step(row)
    driven(phantom, Control(db_x=advance))
    np.testing.assert_allclose(advances, [advance / parts] * parts)


def test_the_tip_is_known_at_any_past_time():
    """Within the last command, within earlier ones, and at rest before the start."""
    phantom = make_phantom()
    tips = [tip(phantom)[:3]]
    for _ in range(3):
        driven(phantom, Control(db_x=0.5, dg_y=0.25))
        tips.append(tip(phantom)[:3])
    for k in range(4):
        np.testing.assert_allclose(phantom.tip_at(0.2 * k), tips[k], atol=1e-9)
    middle = phantom.tip_at(0.3)  # between the two parts of the second command
    assert middle[0] == pytest.approx((tips[1][0] + tips[2][0]) / 2, abs=1e-3)
    quarter = phantom.tip_at(0.25)
    np.testing.assert_allclose(quarter, (np.array(phantom.tip_at(0.2)) + middle) / 2, atol=1e-12)
    assert tips[1][0] < quarter[0] < middle[0] < tips[2][0]
    np.testing.assert_array_equal(phantom.tip_at(-0.3), tips[0])
    np.testing.assert_array_equal(phantom.tip_at(0.7), tips[3])


def test_the_tip_does_not_move_during_a_wait():
    phantom = driven(make_phantom(), AHEAD)
    before = phantom.condition()
    phantom.wait(0.5)
    assert phantom.now() == pytest.approx(0.7)
    for time in (0.2, 0.45, 0.7):
        np.testing.assert_allclose(phantom.tip_at(time), before.tip[:3], atol=1e-12)
    np.testing.assert_array_equal(tip(phantom), before.tip)
    assert phantom.condition()[1:4] == before[1:4]
    np.testing.assert_array_equal(phantom.condition().shape, before.shape)
    driven(phantom, AHEAD)
    np.testing.assert_allclose(phantom.tip_at(0.7), before.tip[:3], atol=1e-12)


@pytest.mark.parametrize(
    "command",
    [
        Control(db_x=2.0),
        Control(db_x=-0.5),
        Control(dg_y=0.6),
        Control(db_x=1.0, db_theta=math.nan),
    ],
)
def test_a_command_beyond_a_limit_is_rejected_before_anything_moves(command):
    phantom = Phantom(draw(PHANTOM, np.random.default_rng(3)), 0.0, "model")
    before = tip(phantom)
    with pytest.raises(CommandError):
        phantom.apply(command, 0.4)
    assert phantom.now() == 0.0
    np.testing.assert_array_equal(tip(phantom), before)


def test_there_are_two_plants_and_the_exact_one_is_the_default():
    assert set(PLANTS) == {"exact", "model"}
    assert DEFAULT_PLANT == "exact"
    with pytest.raises(InputError, match=r"gel.*exact, model"):
        make_phantom(kind="gel")


# ---- both plants


@pytest.fixture(scope="module")
def swung():
    """Both plants without imperfections with the same commands to 45 mm: the guide out and back, a roll at 15 mm."""
    commands = [
        Control(db_x=1.0, dg_y=round(-0.25 * math.cos(math.pi * k / 40), 3), flip=k == 44) for k in range(73)
    ]
    phantoms = {kind: make_phantom(kind=kind) for kind in PLANTS}
    return {
        kind: [driven(phantom, command).condition() for command in commands]
        for kind, phantom in phantoms.items()
    }


def test_without_imperfections_both_plants_agree(swung):
    """Within 0.02 mm in each step at 0.044 rad; tissue energy and stretch within 1 %."""
    exact, model = (np.array([condition.tip for condition in swung[kind]]) for kind in ("exact", "model"))
    apart = np.hypot(*(exact - model)[:, :2].T)
    assert 0.0 < apart.max() < 0.02
    assert np.abs(exact[:, 1]).max() > 2.0
    assert np.abs(exact[:, THETA]).max() > 0.04
    one, other = (swung[kind][-1] for kind in ("exact", "model"))
    assert one.strain_energy == pytest.approx(other.strain_energy, rel=0.01)
    assert one.least_stretch == pytest.approx(other.least_stretch, abs=0.01)
    assert other.least_stretch < 0.97
    assert all(condition.converged for conditions in swung.values() for condition in conditions)


@both_plants
def test_the_recorded_stretch_is_the_smallest_since_the_start(swung, kind):
    """Also after the tissue has relaxed."""
    stretches = [condition.least_stretch for condition in swung[kind]]
    assert all(np.diff(stretches) <= 0.0)
    assert stretches[0] == 1.0
    phantom = driven(make_phantom(kind=kind), AHEAD, times=45)
    compressed = phantom.condition().least_stretch
    driven(phantom, Control(db_x=-1.0, dg_y=-0.1), times=44)
    assert phantom._plant.least_stretch > compressed
    assert phantom.condition().least_stretch <= compressed


# ---- failed steps are reported


def test_one_failed_step_within_a_command_is_reported_permanently():
    phantom = driven(make_phantom(), AHEAD, times=3)
    assert phantom.condition().converged
    phantom._plant.state["load"][0] = -100.0  # many times the buckling load
    driven(phantom, Control(db_x=0.25))
    phantom._plant.state["load"][0] = 0.0
    driven(phantom, AHEAD)
    assert not phantom.condition().converged


def test_a_failed_start_is_reported():
    """Clamped at an angle that is not a number."""
    assert not make_phantom(base_turn=math.nan).condition().converged


def test_the_model_plant_reports_a_failed_step(monkeypatch):
    phantom = driven(make_phantom(kind="model"), AHEAD)
    state = type(phantom._plant._state)
    with monkeypatch.context() as patched:
        patched.setattr(state, "converged", property(lambda _: False))
        driven(phantom, AHEAD)
    driven(phantom, AHEAD)
    assert not phantom.condition().converged


@both_plants
def test_the_true_shape_is_the_needle_in_points_at_equal_distances(kind):
    """Their number is the model's; they are from the base to the end of the axis, on the chain of the plant's nodes."""
    phantom = driven(make_phantom(kind=kind, base_y=0.4, base_z=-0.3), AHEAD, times=SKIN + 10)
    shape, nodes = phantom.condition().shape, phantom._plant.nodes
    assert shape.shape == (IDEAL.needle.nodes, 3)
    spacing = np.linalg.norm(np.diff(shape, axis=0), axis=1)
    np.testing.assert_allclose(spacing, spacing.mean(), rtol=1e-3)  # a chord is shorter than its arc
    np.testing.assert_allclose(shape[0], nodes[0], atol=1e-12)
    np.testing.assert_allclose(shape[-1], phantom._plant.tip[:3], atol=1e-9)
    for column in (1, 2):
        between = np.interp(shape[:, 0], nodes[:, 0], nodes[:, column])
        np.testing.assert_allclose(shape[:, column], between, atol=1e-3)


def test_points_at_equal_distances_are_along_the_chain():
    corner = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 1.0, 0.0]])
    points = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 1.0, 0.0]]
    np.testing.assert_allclose(evenly_spaced(corner, 3), points, atol=1e-15)


def test_a_plant_without_nodes_has_no_shape():
    class Without:
        def __init__(self, truth, roll):
            self._plant = make_plant("model", truth, roll)

        def __getattr__(self, name):
            if name == "nodes":
                raise AttributeError(name)
            return getattr(self._plant, name)

    assert make_phantom(kind=Without).condition().shape is None
