"""States as values, and commands that are refused."""

import copy
import math
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexneedle import Control, Simulator, controls, load_scenario
from flexneedle.errors import CommandError, InputError, StateError
from flexneedle.mechanics.rollout import rollout
from flexneedle.scenario.dotted import split_key
from flexneedle.scenario.problems import key_path
from reference.cases import insert_to, numbers, repeat, with_number

PHANTOM = load_scenario("phantom")
SIMULATOR = Simulator(PHANTOM)
ON = Control(db_x=0.7, dg_y=-0.2, flip=True)


@pytest.fixture(scope="module")
def state():
    """A bent needle, pulled back a little."""
    deep = repeat(SIMULATOR, insert_to(SIMULATOR, 15.0), Control(db_x=1.0, dg_y=0.2), 10)[-1]
    return SIMULATOR.step(deep, Control(db_x=-0.6))


def same_future(one, other):
    """Return whether the next step of both gives the same bytes."""
    return SIMULATOR.step(one, ON).nodes.tobytes() == SIMULATOR.step(other, ON).nodes.tobytes()


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state))]
)
def test_copies_are_equal_and_have_the_same_future(state, duplicate):
    """Copied, deeply copied, pickled; no kernel is compiled for the copy."""
    kernels = len(rollout.signatures)
    twin = duplicate(state)
    assert twin == state
    assert hash(twin) == hash(state)
    assert same_future(twin, state)
    assert len(rollout.signatures) == kernels


def test_states_compare_by_value(state):
    """By their arrays and the scenario; other things are not states."""
    assert state != SIMULATOR.step(state, Control(db_x=0.1))
    assert state != state.with_estimate(tip_load=(1e-3, 0.0))
    assert SIMULATOR.step(state, ON) == SIMULATOR.step(state, ON)
    assert state != 3
    assert state.with_estimate() == state
    assert state != replace(state, scenario=PHANTOM.with_values({"plan.samples": 77}))
    assert hash(state) == hash(replace(state, scenario=load_scenario("phantom")))


def test_a_correction_replaces_the_one_before():
    """Position and slope of the base, and the origin of its travel: only the last correction counts."""
    start = SIMULATOR.start()
    last = {"base_x": -170.0, "base": (0.2, 0.0), "slope": (1e-3, 0.0)}
    first = {"base_x": -171.0, "base": (-0.5, 0.0), "slope": (-2e-3, 0.0)}
    twice = start.with_estimate(**first).with_estimate(**last)
    np.testing.assert_allclose(numbers(twice), numbers(start.with_estimate(**last)), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(twice.travel, 0.0, atol=1e-12)


BITS = st.integers(0, 2**64 - 1)
TROUBLE = [0.0, -0.0, np.nan, -np.nan, np.inf, -np.inf, 5e-324, 1.0]
NUMBERS = st.sampled_from(TROUBLE) | BITS.map(lambda bits: float(np.uint64(bits).view(np.float64)))


@given(place=st.integers(0, numbers(SIMULATOR.start()).size - 1), one=NUMBERS, other=NUMBERS)
def test_states_are_equal_if_and_only_if_their_bits_are_and_then_hash_equally(place, one, other):
    """−0 and NaN included: equality is an equivalence, and equal states are one in a set."""
    start = SIMULATOR.start()

    def changed(value):
        return with_number(start, place, value)

    a, b = changed(one), changed(other)
    assert a == changed(one)
    assert hash(a) == hash(changed(one))
    assert (a == b) is (b == a) is (numbers(a).tobytes() == numbers(b).tobytes())
    assert len({a, b}) == 2 - (a == b)


# ---- other scenarios


@pytest.mark.parametrize(
    ("key", "value"),
    [("tissue.1.alpha", 9.0), ("needle.bevel.offset_mm", 3.5), ("setup.guide_to_skin_mm", None)],
)
def test_a_state_of_other_mechanics_is_refused_with_the_key(state, key, value):
    """In a step, a rollout and an assimilation, with both values."""
    other = Simulator(PHANTOM.with_values({key: value}))
    uses = (
        lambda: other.step(state, ON),
        lambda: other.rollout(state, [[ON]]),
        lambda: other.assimilate(state, state.tip[:2]),
    )
    for use in uses:
        with pytest.raises(StateError) as caught:
            use()
        assert all(
            part in str(caught.value)
            for part in (key_path(split_key(key)), str(PHANTOM.flat()[key]), str(value or "none"))
        )


def test_planner_controller_and_target_are_no_part_of_the_mechanics(state):
    other = Simulator(PHANTOM.with_values({"plan.samples": 77, "target.depth_mm": 30.0, "name": "Other"}))
    assert other.step(state, ON).nodes.tobytes() == SIMULATOR.step(state, ON).nodes.tobytes()


# ---- values that nobody changes


def test_the_arrays_of_a_state_are_read_only(state):
    for array in (state.rest, state.compression, state.mesh, state.nodes, *state.contacts):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    with pytest.raises(AttributeError):
        state.needle.solution.tip.y = 0.0


def test_neither_properties_nor_steps_change_a_state(state):
    """Properties return copies; steps and assimilation return new states."""
    before = pickle.dumps((state.needle, state.rest, state.compression, state.mesh))
    state.tip[:] = 99.0
    state.base[:] = 99.0
    _ = state.nodes, state.contacts, state.energy, state.strain_energy, state.reactions
    first = SIMULATOR.step(state, ON)
    SIMULATOR.assimilate(state, np.add(state.tip[:2], [0.0, 0.2]))
    assert pickle.dumps((state.needle, state.rest, state.compression, state.mesh)) == before
    assert state.tip[0] != 99.0
    assert first == SIMULATOR.step(state, ON)


@pytest.mark.parametrize(("roll", "bevel"), [(math.pi, -1), (0.0, 1)])
def test_the_start_is_straight_and_in_air(roll, bevel):
    start = SIMULATOR.start(roll)
    np.testing.assert_array_equal(start.tip, [-28.5, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(start.base, [-178.5, 0.0, 0.0, 0.0, 0.0])
    assert (start.bevel, start.guide, start.energy, start.contacts.x.size) == (bevel, (0.0, 0.0), 0.0, 0)
    assert start.roll == roll


# ---- limits of commands


@pytest.mark.parametrize(
    ("preset", "changes", "control", "name", "limit", "rule"),
    [
        ("phantom", {}, {"db_x": 1.001}, "db_x", 1.0, "at most 1 mm"),
        ("phantom", {}, {"db_x": -1.2}, "db_x", 1.0, "at most 1 mm"),
        ("phantom", {}, {"db_y": 0.6}, "db_y", 0.5, "at most 0.5 mm"),
        ("phantom", {}, {"db_theta": -0.0051}, "db_theta", 0.005, "at most 0.005 rad"),
        ("phantom", {}, {"dg_y": 0.5001}, "dg_y", 0.5, "at most 0.5 mm"),
        ("phantom", {}, {"db_x": -0.1}, "db_x", 0.0, "at least 0 mm"),
        ("phantom", {}, {"db_theta": np.nan}, "db_theta", np.nan, "finite"),
        ("phantom", {}, {"dg_y": -np.inf}, "dg_y", np.nan, "finite"),
        ("phantom", {}, {"dg_z": 0.1}, "dg_z", 0.0, "setup.axes = 1"),
        ("phantom", {}, {"db_z": -0.1}, "db_z", 0.0, "setup.axes = 1"),
        ("phantom", {}, {"db_psi": 0.001}, "db_psi", 0.0, "setup.axes = 1"),
        ("phantom", {}, {"roll": -2.0}, "roll", np.pi, "half turns with setup.axes = 1"),
        ("phantom", {}, {"spin": 1.0}, "spin", 0.0, "setup.axes = 1"),
        ("phantom3d", {"setup.guide_axes": 1}, {"dg_z": 0.1}, "dg_z", 0.0, "setup.guide_axes = 1"),
        ("phantom3d", {"setup.guide_to_skin_mm": None}, {"dg_z": 0.1}, "dg_z", 0.0, "setup.guide_to_skin_mm"),
        ("phantom", {"setup.guide_to_skin_mm": None}, {"dg_y": 0.1}, "dg_y", 0.0, "setup.guide_to_skin_mm"),
        (
            "phantom3d",
            {"setup.max_rotation_deg": 60.0},
            {"roll": 1.0, "spin": 0.2},
            "roll",
            np.pi / 3.0,
            "setup.max_rotation_deg = 60",
        ),
    ],
)
def test_a_command_out_of_range_is_refused_with_value_limit_and_rule(
    preset, changes, control, name, limit, rule
):
    """Never clipped; in a step and in a rollout."""
    simulator = Simulator(load_scenario(preset).with_values(changes))
    for use in (simulator.step, lambda state, command: simulator.rollout(state, [[command]])):
        with pytest.raises(CommandError) as caught:
            use(simulator.start(), Control(**control))
        error = caught.value
        assert (error.name, error.limit) == (name, pytest.approx(limit, nan_ok=True))
        assert error.value == pytest.approx(sum(control.values()), nan_ok=True)
        assert rule in str(error)


def test_the_start_is_rolled_by_half_turns_in_the_plane():
    with pytest.raises(CommandError) as caught:
        SIMULATOR.start(1.0)
    assert caught.value.name == "roll"


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_travel_is_the_sum_of_the_commands_also_along_a_tilted_entry(preset):
    """The base advances along the axis; the lateral part of that advance does not count as lateral travel."""
    tilt = {"entry.slope_mrad": 40.0} | ({"entry.slope_z_mrad": -30.0} if preset == "phantom3d" else {})
    simulator = Simulator(load_scenario(preset).with_values(tilt))
    state = repeat(simulator, simulator.start(), Control(db_x=1.0, db_y=0.01, dg_y=0.02), 20)[-1]
    np.testing.assert_allclose(state.travel, [20.0, 0.2, 0.0, 0.0, 0.0, 0.4, 0.0], atol=1e-10)


@pytest.mark.parametrize(
    ("name", "step", "travel"), [("db_x", 1.0, 110.0), ("dg_y", 0.5, 15.0), ("db_y", -0.5, 15.0)]
)
def test_travel_is_limited(name, step, travel):
    """To the stroke and the guide's and base's range, in single steps and in a rollout."""
    times = round(travel / abs(step))
    rows = controls(1, times + 1, **{name: step})
    SIMULATOR.rollout(SIMULATOR.start(), rows[:, :-1])
    end, _ = SIMULATOR.replay(SIMULATOR.start(), rows[0, :-1])
    for use in (
        lambda: SIMULATOR.step(end, Control(**{name: step / 100})),
        lambda: SIMULATOR.rollout(SIMULATOR.start(), rows),
    ):
        with pytest.raises(CommandError) as caught:
            use()
        assert (caught.value.name, caught.value.limit) == (name, math.copysign(travel, step))


@pytest.mark.parametrize(
    ("shape", "columns", "value"),
    [
        (((4, 30),), {}, "size = (4, 30): "),
        ((-3,), {}, "size = -3: "),
        ((4, 30), {"dg_z": [0.1, 0.2]}, "dg_z = [0.1, 0.2]: "),
        ((3,), {"roll": "a"}, "roll = 'a': "),
        ((3,), {"dgz": 0.1}, "column = 'dgz': must be one of db_x, "),
    ],
)
def test_controls_that_cannot_be_made_are_refused(shape, columns, value):
    with pytest.raises(InputError) as caught:
        controls(*shape, **columns)
    assert str(caught.value).startswith(value)


@pytest.mark.parametrize("shape", [(9,), (3, 9), (2, 3, 5), (1, 2, 3, 9)])
def test_controls_of_another_shape_are_refused(shape):
    with pytest.raises(InputError, match=re.escape(f"shape of controls = {shape}: ")):
        SIMULATOR.rollout(SIMULATOR.start(), np.zeros(shape))


def test_control_rows_round_trip():
    """Columns as in a rollout, a flip as half a turn."""
    control = Control(0.5, db_y=-0.1, db_theta=2e-3, dg_y=0.3, flip=True)
    np.testing.assert_array_equal(control, [0.5, -0.1, 0.0, 2e-3, 0.0, 0.3, 0.0, np.pi, 0.0])
    assert Control.of(np.array(control)) == control
    assert Control.of(np.array(Control())) == Control()
