"""Arguments of rollouts and adaptations that cannot be used: one line with value and rule."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from flexneedle import Adaptation, Simulator, controls, load_scenario
from flexneedle.errors import FlexneedleError
from flexneedle.simulator import batch

PHANTOM = load_scenario("phantom")
PLANE, SPACE = Simulator(PHANTOM, 1), Simulator("phantom3d", 1)
OTHER_POINTS = Simulator(PHANTOM.with_values({"contact.spacing_mm": 1.01}))  # as many
START, ROWS = PLANE.start(), controls(3, 20, db_x=1.0, dg_y=0.02)
NONE, SAME = np.zeros(1), np.ones(2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: PLANE.rollout(START, "abc"), "controls = 'abc': must be numbers"),
        (lambda: PLANE.rollout(START, ROWS[0]), r"shape of controls = \(20, 9\): must be \(N, m, 9\)"),
        (lambda: PLANE.rollout(START, ROWS * np.nan, limits=False), "db_x = nan: must be a finite number"),
        (lambda: PLANE.rollout(START, ROWS, axes="x"), r"axes = 'x': must be numbers \(3, 2\)"),
        (lambda: PLANE.rollout(START, ROWS, axes=[[np.nan, 0.0]] * 3), "axes = .* must be finite"),
        (lambda: PLANE.rollout(START, ROWS, outputs=3), "output = 3: must be one of energy"),
        (lambda: PLANE.rollout(None, ROWS), "state = None: must be a State"),
        (lambda: PLANE.rollout([], ROWS), "number of states = 0: must be 3"),
        (lambda: PLANE.rollout([START] * 2, ROWS), "number of states = 2: must be 3"),
        (
            lambda: PLANE.rollout([START, SPACE.start(), START], ROWS),
            "setup.axes and needle.nodes = .* the same",
        ),
        (lambda: PLANE.rollout(START, ROWS, models=PLANE.model), "number of models = 1: must be 3"),
        (lambda: PLANE.rollout(START, ROWS, models=[OTHER_POINTS.model] * 3), "model 0 = .* contact points"),
        (lambda: PLANE.with_model(SPACE.model), "model = '89 points on 2 axes': must have the axes"),
        (lambda: PLANE.with_model(Adaptation(NONE, SAME)), "model = .*must be a Model"),
        (lambda: PLANE.replay(START, ROWS), r"shape of controls = \(3, 20, 9\): must be \(m, 9\)"),
        (lambda: PLANE.replay(START, np.full((2, 9), np.inf)), "db_x = inf: must be a finite number"),
    ],
)
def test_arguments_that_cannot_be_used(call, message):
    with pytest.raises(FlexneedleError, match=message):
        call()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shift": np.ones(2)}, r"shift = .* must be an array \(1,\)"),
        ({"shift": [np.nan]}, "shift = .* must be finite"),
        ({"stiffness": [1.0, "soft"]}, "stiffness = .* must be real numbers"),
        ({"stiffness": [1.0, 0.0]}, "stiffness = .* must be above 0"),
        ({"variation": 2.0}, r"variation = 2.0: must be an array \(c,\)"),
        ({"cell": np.ones(3)}, "cell = .* must be a number"),
        ({"bevel": -0.1}, "bevel = -0.1: must be at least 0"),
        ({"bend": 1j}, "bend = 1j: must be real numbers"),
        ({"clearance": np.nan}, "clearance = nan: must be finite"),
    ],
)
def test_adaptations_that_cannot_be_used(changes, message):
    with pytest.raises(FlexneedleError, match=message):
        PLANE.adapt(Adaptation(**({"shift": NONE, "stiffness": SAME} | changes)))


def test_adaptations_take_sequences_and_are_relative_to_the_scenario():
    changes = Adaptation([0.5], (1.5, 2.0), variation=[1.0, 1.2], bend=0.3, clearance=0.1)
    adapted = PLANE.adapt(changes)
    again = PLANE.with_model(adapted).adapt(changes)
    assert again.nodes.tobytes() == adapted.nodes.tobytes()
    assert again._replace(nodes=0, layers=0, laws=0) == adapted._replace(nodes=0, layers=0, laws=0)


@pytest.mark.parametrize("kind", [int, np.float32, float, complex])
def test_lines_of_any_numbers_are_the_same(kind):
    lines = np.array([[1, 0], [2, 1], [0, 0]], dtype=kind)
    found = PLANE.rollout(START, ROWS, axes=lines, outputs=("deflection",)).deflection
    expected = PLANE.rollout(START, ROWS, axes=lines.astype(complex), outputs=("deflection",)).deflection
    np.testing.assert_array_equal(found, expected)
    assert len(set(found[:, -1])) == 3


def test_a_state_that_fits_a_measurement_has_the_model_of_its_simulator():
    simulator = PLANE.with_model(PLANE.adapt(Adaptation(NONE, 2.0 * SAME, clearance=0.1)))
    state, _ = simulator.replay(PLANE.start(), ROWS[0])
    assert simulator.assimilate(state, state.tip[:2]).state.model is simulator.model
    with pytest.raises(FlexneedleError, match=r"must be past the guide .* clearance"):
        simulator.assimilate(state, state.tip[:2], [(PHANTOM.setup.guide_x - 5.0, 0.0)])


def test_empty_results_have_a_text():
    assert "0 sequences of 20 steps" in repr(PLANE.rollout(START, ROWS[:0]))
    assert "3 sequences of 0 steps" in repr(PLANE.rollout(START, ROWS[:, :0]))


def test_a_rollout_does_not_wait_for_the_work_of_another(monkeypatch):
    """All threads of the pool are busy with another rollout: the calling thread does all of the work."""
    release, begun = threading.Event(), threading.Barrier(3)
    pool = ThreadPoolExecutor(2)
    monkeypatch.setattr(batch, "_pool", lambda: pool)

    def occupy():
        begun.wait(30.0)
        release.wait(30.0)

    others = [pool.submit(occupy) for _ in range(2)]
    begun.wait(30.0)
    done = []
    batch._share(lambda first, last: done.append((first, last)), 64, 2)
    assert [first for first, _ in done[1:]] == [last for _, last in done[:-1]]
    assert (done[0][0], done[-1][1]) == (0, 64)
    assert not any(other.done() for other in others)
    release.set()
    pool.shutdown()
