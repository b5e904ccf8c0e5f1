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
from flexneedle.mechanics import insertion
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
    """Whether both go on to the same bytes."""
    return SIMULATOR.step(one, ON).nodes.tobytes() == SIMULATOR.step(other, ON).nodes.tobytes()


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda state: pickle.loads(pickle.dumps(state))]
)
def test_copies_are_equal_and_go_on_the_same(state, duplicate):
    """Copied, deeply copied, pickled."""
    kernels = len(insertion._rollout.signatures)
    twin = duplicate(state)
    assert twin == state
    assert hash(twin) == hash(state)
    assert same_future(twin, state)
    assert len(insertion._rollout.signatures) == kernels  # none was compiled for the copy


def test_states_compare_by_value(state):
    """A step makes a difference, and so does a correction; other things are not states."""
    assert state != SIMULATOR.step(state, Control(db_x=0.1))
    assert state != state.with_estimate(tip_load=(1e-3, 0.0))
    assert SIMULATOR.step(state, ON) == SIMULATOR.step(state, ON)
    assert state != 3
    assert state.with_estimate() == state


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
def test_states_are_equal_just_where_their_bits_are_and_then_hash_equally(place, one, other):
    """−0 and NaN included: equality is an equivalence, and equal states find each other in a set."""
    start = SIMULATOR.start()

    def changed(value):
        return with_number(start, place, value)

    a, b = changed(one), changed(other)
    assert a == changed(one)
    assert hash(a) == hash(changed(one))
    assert (a == b) is (b == a) is (numbers(a).tobytes() == numbers(b).tobytes())
    assert len({a, b}) == 2 - (a == b)


def test_states_of_other_scenarios_differ(state):
    """Whatever their arrays are."""
    assert state != replace(state, scenario=PHANTOM.with_values({"plan.samples": 77}))
    assert hash(state) == hash(replace(state, scenario=load_scenario("phantom")))


def test_saved_state_loads_equal(state, tmp_path):
    """From a file, by text or path."""
    path = tmp_path / "needle.npz"
    state.save(path)
    loaded = SIMULATOR.load(str(path))
    assert loaded == state
    assert same_future(loaded, state)
    assert not loaded.rest.flags.writeable


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tissue.1.alpha", 9.0),
        ("needle.bevel.offset_mm", 3.5),
        ("contact.spacing_mm", 0.5),
        ("setup.guide_to_skin_mm", None),
    ],
)
def test_state_of_other_mechanics_is_refused_with_the_key(state, tmp_path, key, value):
    """In a step, a rollout, an assimilation and a file, with both values."""
    other = Simulator(PHANTOM.with_values({key: value}))
    path = tmp_path / "needle.npz"
    state.save(path)
    uses = (
        lambda: other.step(state, ON),
        lambda: other.rollout(state, [[ON]]),
        lambda: other.assimilate(state, state.tip[:2]),
        lambda: other.load(path),
    )
    for use in uses:
        with pytest.raises(StateError) as caught:
            use()
        assert key in str(caught.value)
        assert str(PHANTOM.flat()[key]) in str(caught.value)
        assert str(value) in str(caught.value)


def test_state_of_a_scenario_with_another_plan_is_welcome(state, tmp_path):
    """Planner, controller and target are no part of the mechanics."""
    other = Simulator(PHANTOM.with_values({"plan.samples": 77, "target.depth_mm": 30.0, "name": "Other"}))
    path = tmp_path / "needle.npz"
    state.save(path)
    assert other.step(other.load(path), ON).nodes.tobytes() == SIMULATOR.step(state, ON).nodes.tobytes()


@pytest.mark.parametrize("content", [b"plain text", b"", b"PK\x03\x04 no"])
def test_file_that_is_no_state_is_refused(tmp_path, content):
    """One clear error, whatever the file holds."""
    path = tmp_path / "needle.npz"
    path.write_bytes(content)
    with pytest.raises(StateError, match=r"needle\.npz"):
        SIMULATOR.load(path)
    with pytest.raises(StateError, match="absent"):
        SIMULATOR.load(tmp_path / "absent")


def test_file_with_other_arrays_is_refused(tmp_path):
    """An npz of something else."""
    path = tmp_path / "needle.npz"
    np.savez(path, x=np.zeros(3))
    with pytest.raises(StateError, match="not a saved state"):
        SIMULATOR.load(path)


def test_arrays_of_a_state_are_read_only(state):
    """What the next step starts from, and what is read from it."""
    for array in (state.rest, state.compression, state.mesh, state.nodes, *state.contacts):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    with pytest.raises(AttributeError):
        state.needle.solution.tip.y = 0.0


def test_reading_a_state_changes_nothing(state):
    """Properties have no effects, and hand out copies."""
    before = pickle.dumps((state.needle, state.rest, state.compression, state.mesh))
    state.tip[:] = 99.0
    state.base[:] = 99.0
    _ = state.nodes, state.contacts, state.energy, state.strain_energy, state.reactions
    assert pickle.dumps((state.needle, state.rest, state.compression, state.mesh)) == before
    assert state.tip[0] != 99.0


def test_step_returns_a_new_state(state):
    """The old one stays as it was, after steps and assimilation."""
    before = pickle.dumps((state.needle, state.rest, state.compression, state.mesh))
    first = SIMULATOR.step(state, ON)
    SIMULATOR.assimilate(state, np.add(state.tip[:2], [0.0, 0.2]))
    assert pickle.dumps((state.needle, state.rest, state.compression, state.mesh)) == before
    assert first == SIMULATOR.step(state, ON)


def test_simulator_pickles(state):
    """For worker processes."""
    simulator = pickle.loads(pickle.dumps(Simulator(PHANTOM, threads=3)))
    assert simulator.threads == 3
    assert simulator.step(state, ON) == SIMULATOR.step(state, ON)


def test_start_is_straight_and_in_air():
    """Tip before the skin, nothing bent, both bevels."""
    for roll, bevel in ((math.pi, -1), (0.0, 1)):
        start = SIMULATOR.start(roll)
        np.testing.assert_array_equal(start.tip, [-28.5, 0.0, 0.0, 0.0, 0.0])
        np.testing.assert_array_equal(start.base, [-178.5, 0.0, 0.0, 0.0, 0.0])
        assert (start.bevel, start.guide, start.energy, start.contacts.x.size) == (bevel, (0.0, 0.0), 0.0, 0)
        assert start.roll == roll
    with pytest.raises(CommandError, match=r"roll = 1: must be half turns with setup\.axes = 1"):
        SIMULATOR.start(1.0)


@pytest.mark.parametrize(
    ("control", "name", "value", "limit"),
    [
        ({"db_x": 1.001}, "db_x", 1.001, 1.0),
        ({"db_x": -1.2}, "db_x", -1.2, 1.0),
        ({"db_y": 0.6}, "db_y", 0.6, 0.5),
        ({"db_theta": -0.0051}, "db_theta", -0.0051, 0.005),
        ({"dg_y": 0.5001}, "dg_y", 0.5001, 0.5),
        ({"db_x": -0.1}, "db_x", -0.1, 0.0),
    ],
)
def test_command_out_of_range_is_refused_with_value_and_limit(control, name, value, limit):
    """From the start; never clipped."""
    with pytest.raises(CommandError) as caught:
        SIMULATOR.step(SIMULATOR.start(), Control(**control))
    error = caught.value
    assert (error.name, error.limit) == (name, pytest.approx(limit))
    assert error.value == pytest.approx(value)
    assert f"{name} = {value:g}" in str(error)
    assert f"{limit:g}" in str(error)


@pytest.mark.parametrize("name", ["db_x", "db_y", "db_theta", "dg_y"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_command_that_is_no_number_is_refused(name, value):
    """NaN and infinity."""
    with pytest.raises(CommandError, match=rf"{name} = .*finite"):
        SIMULATOR.step(SIMULATOR.start(), Control(**{name: value}))


@pytest.mark.parametrize("preset", ["phantom", "phantom3d"])
def test_travel_is_the_sum_of_the_commands_also_along_a_tilted_entry(preset):
    """The base advances along the axis; what it moves sideways by that does not count as lateral travel."""
    tilt = {"entry.slope_mrad": 40.0} | ({"entry.slope_z_mrad": -30.0} if preset == "phantom3d" else {})
    simulator = Simulator(load_scenario(preset).with_values(tilt))
    state = simulator.start()
    for _ in range(20):
        state = simulator.step(state, Control(db_x=1.0, db_y=0.01, dg_y=0.02))
    np.testing.assert_allclose(state.travel, [20.0, 0.2, 0.0, 0.0, 0.0, 0.4, 0.0], atol=1e-10)


@pytest.mark.parametrize(
    ("name", "step", "travel"), [("db_x", 1.0, 110.0), ("dg_y", 0.5, 15.0), ("db_y", -0.5, 15.0)]
)
def test_travel_is_limited(name, step, travel):
    """To the stroke and the guide's and base's range, in single steps and in a rollout."""
    times = round(travel / abs(step))
    end = repeat(SIMULATOR, SIMULATOR.start(), Control(**{name: step}), times)[-1]
    with pytest.raises(
        CommandError, match=rf"{name} = .*sum of the steps must be at (most|least) -?{travel:g} mm"
    ):
        SIMULATOR.step(end, Control(**{name: step / 100}))
    rows = controls(1, times + 1, **{name: step})
    SIMULATOR.rollout(SIMULATOR.start(), rows[:, :-1])
    with pytest.raises(CommandError, match=rf"{name} = "):
        SIMULATOR.rollout(SIMULATOR.start(), rows)


def test_guide_that_is_not_there_cannot_move():
    """Limit 0."""
    simulator = Simulator(PHANTOM.with_values({"setup.guide_to_skin_mm": None}))
    with pytest.raises(CommandError) as caught:
        simulator.step(simulator.start(), Control(dg_y=0.1))
    assert (caught.value.name, caught.value.limit) == ("dg_y", 0.0)


NO_GUIDE = "must be 0 without a guide (setup.guide_to_skin_mm)"


@pytest.mark.parametrize(
    ("preset", "changes", "control", "message"),
    [
        ("phantom", {}, {"dg_z": 0.1}, "dg_z = 0.1: must be 0 with setup.axes = 1"),
        ("phantom", {}, {"db_z": -0.1}, "db_z = -0.1: must be 0 with setup.axes = 1"),
        ("phantom", {}, {"db_psi": 0.001}, "db_psi = 0.001: must be 0 with setup.axes = 1"),
        (
            "phantom3d",
            {"setup.guide_axes": 1},
            {"dg_z": 0.1},
            "dg_z = 0.1: must be 0 with setup.guide_axes = 1",
        ),
        ("phantom3d", {"setup.guide_to_skin_mm": None}, {"dg_z": 0.1}, f"dg_z = 0.1: {NO_GUIDE}"),
        ("phantom3d", {"setup.guide_to_skin_mm": None}, {"dg_y": 0.1}, f"dg_y = 0.1: {NO_GUIDE}"),
        (
            "phantom3d",
            {"setup.max_rotation_deg": 60.0},
            {"roll": 1.0, "spin": 0.2},
            "roll = 1.2: angle of the needle must be at most 1.0472 rad to either side (setup.max_rotation_deg = 60)",
        ),
    ],
)
def test_what_the_rig_cannot_do_is_refused_with_the_key(preset, changes, control, message):
    simulator = Simulator(load_scenario(preset).with_values(changes))
    with pytest.raises(CommandError) as caught:
        simulator.step(simulator.start(), Control(**control))
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("shape", "columns", "message"),
    [
        (((4, 30),), {}, "size = (4, 30): must be a whole number, at least 0; give the sizes one by one"),
        ((-3,), {}, "size = -3: must be a whole number, at least 0"),
        (
            (4, 30),
            {"dg_z": [0.1, 0.2]},
            "dg_z = [0.1, 0.2]: must be numbers that broadcast to the shape (4, 30)",
        ),
        ((3,), {"roll": "a"}, "roll = 'a': must be numbers that broadcast to the shape (3,)"),
        ((3,), {"dgz": 0.1}, "column = 'dgz': must be one of db_x, "),
    ],
)
def test_controls_that_cannot_be_made_are_one_clear_line(shape, columns, message):
    with pytest.raises(InputError) as caught:
        controls(*shape, **columns)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("shape", [(9,), (3, 9), (2, 3, 5), (1, 2, 3, 9)])
def test_controls_of_another_shape_are_refused(shape):
    """With the shape in the message."""
    with pytest.raises(
        InputError, match=f"shape of controls = {re.escape(str(shape))}: must be \\(N, m, 9\\)"
    ):
        SIMULATOR.rollout(SIMULATOR.start(), np.zeros(shape))


@pytest.mark.parametrize("roll", [1.0, -2.0, 0.5 * np.pi])
def test_a_needle_in_the_plane_rolls_by_half_turns(roll):
    """Nothing between, and no spin."""
    with pytest.raises(CommandError, match=r"roll = .*must be half turns with setup\.axes = 1"):
        SIMULATOR.rollout(SIMULATOR.start(), [[Control(roll=roll)]])
    with pytest.raises(CommandError, match=r"spin = .*must be 0 with setup\.axes = 1"):
        SIMULATOR.rollout(SIMULATOR.start(), [[Control(spin=roll)]])


def test_control_rows_round_trip():
    """Columns as in a rollout, a flip as half a turn."""
    control = Control(0.5, db_y=-0.1, db_theta=2e-3, dg_y=0.3, flip=True)
    np.testing.assert_array_equal(control, [0.5, -0.1, 0.0, 2e-3, 0.0, 0.3, 0.0, np.pi, 0.0])
    assert Control.of(np.array(control)) == control
    assert Control.of(np.array(Control())) == Control()
