"""The work of base, guide, held tip and the slide along the channel is the stored energy.

The needle slides while it bends (equation 5), through a guide at rest, and the slide does work at the tip: on the
fading spring, on points that lose weight, on the slope of a held tip. It is a 200th of the work of one or two
millimetres of lateral motion, and 0 when the tip is out of the bevel's spring and past the growth of the last point.
`axial_force` counts it.
"""

import numpy as np
import pytest

from flexneedle import Control, load_scenario
from flexneedle.types import THETA
from reference.cases import insert_to, repeat, tight

PHANTOM = load_scenario("phantom").with_values({"setup.max_base_turn_step_mrad": 50.0})
SIMULATOR = tight(PHANTOM)
MOVES = {  # base y, base turn, guide y, held tip y, held slope of the tip: mm and rad in all
    "base": (2.0, 0.0, 0.0, 0.0, 0.0),
    "turn": (0.0, 0.02, 0.0, 0.0, 0.0),
    "guide": (0.0, 0.0, 2.0, 0.0, 0.0),
    "tip": (0.0, 0.0, 0.0, 1.5, 0.0),
    "all": (2.0, -0.016, -1.4, 1.0, 0.0),
    "slope": (0.0, 0.0, 0.0, 0.0, 0.03),
    "pose": (1.0, 0.0, -1.4, 1.0, -0.03),
}


def withdrawn(by):
    """Return a bent needle, its bevel rolled during the insertion, drawn back without cutting by `by` mm."""
    state = insert_to(SIMULATOR, 17.0)
    state = SIMULATOR.step(state, Control(db_x=1.0, flip=True))
    state = repeat(SIMULATOR, state, Control(db_x=1.0, dg_y=0.02), 12)[-1]
    return repeat(SIMULATOR, state, Control(db_x=-by / 10), 10)[-1]


def lateral_forces(state):
    """Return the work-conjugates of base y, base turn, guide y, held tip y, held slope of the tip."""
    return np.array(state.reactions)[:, 0]


def axial_force(state):
    """Return ∂(energy)/∂x_t with base and guide at rest: growing points, growing spring, a push on a slope."""
    x, energy, front = state.mesh["x"], state.mesh["energy"], state.needle.channel.front
    behind = state.tip[0] - x
    growing = (x > 0.0) & (behind < PHANTOM.contact.spacing_mm / 2)
    length = state.tip[0] - max(0.0, front - PHANTOM.needle.bevel.length_mm)
    spring = state.spring_energy / length if length > 0.0 else 0.0
    return (
        (energy[growing] / behind[growing]).sum()
        + spring
        - state.needle.solution.loads.tip * state.tip[THETA]
        - state.needle.solution.loads.couple**2 / (2 * PHANTOM.needle.bending_stiffness)
    )


def base_axial_force(state):
    """∂(energy)/∂b_x: bent needle drawn into the clamp, a lateral force on a slope."""
    force, moment, *_ = lateral_forces(state)
    return moment**2 / (2 * PHANTOM.needle.bending_stiffness) - force * state.base[THETA]


def travel(state, move, advance=0.0, steps=60):
    """(lateral work, axial work, change of energy) over a move, by the trapezoid rule."""
    held, energy, lateral, axial = state.tip[[1, THETA]], state.energy, 0.0, 0.0
    each = np.array(move) / steps
    db_y, db_theta, dg_y = each[:3]
    for _ in range(steps):
        after = SIMULATOR.step(state, Control(db_x=advance / steps, db_y=db_y, db_theta=db_theta, dg_y=dg_y))
        if any(move[3:]):
            held = held + each[3:]
            slope = held[1:] if move[4] else None
            after = SIMULATOR.assimilate(after, (after.tip[0], held[0]), slope=slope).state
        lateral += (lateral_forces(state) + lateral_forces(after)) @ each / 2
        slide = after.tip[0] - state.tip[0]
        axial += (axial_force(state) + axial_force(after)) * slide / 2
        axial += (base_axial_force(state) + base_axial_force(after)) * advance / steps / 2
        if not after.tip[0] < after.needle.channel.front:
            raise ValueError("this move cuts")
        state = after
    return lateral, axial, state.energy - energy


def first_hold(state):
    """The state with its tip held where it is."""
    return SIMULATOR.assimilate(state, state.tip[:2]).state


@pytest.mark.parametrize("name", ["slope", "pose"])
def test_work_of_a_held_slope_is_the_energy_stored(name):
    """Its moment turns the tip."""
    lateral, axial, stored = travel(first_hold(withdrawn(3.55)), MOVES[name])
    assert abs(stored) > 0.02
    assert lateral + axial == pytest.approx(stored, rel=1e-4)


@pytest.mark.parametrize("name", ["tip", "all"])
def test_work_of_a_held_tip_is_the_energy_stored(name):
    """Within 0.2 % by lateral work alone, to a hundred-thousandth with the work of the slide along the hold."""
    lateral, axial, stored = travel(first_hold(withdrawn(3.55)), MOVES[name])
    assert abs(stored) > 0.02
    assert lateral == pytest.approx(stored, rel=2e-3)
    assert lateral + axial == pytest.approx(stored, rel=2e-5)


@pytest.mark.parametrize("name", ["base", "tip", "all"])
def test_work_with_the_bevels_spring_is_the_energy_stored(name):
    """Tip spring included; its fading with the slide is 0.2 to 1 % of the work here."""
    lateral, axial, stored = travel(withdrawn(0.4), MOVES[name])
    assert abs(stored) > 0.01
    assert lateral == pytest.approx(stored, rel=0.02)
    assert lateral + axial == pytest.approx(stored, rel=1e-4)


def test_work_of_drawing_back_is_the_energy_released():
    """An axial move, through points that lose weight and a spring that fades, with the base moving laterally."""
    errors = []
    for steps in (100, 400):
        lateral, axial, stored = travel(
            withdrawn(0.4), (2.0, -0.016, -1.4, 0.0, 0.0), advance=-2.0, steps=steps
        )
        errors.append(abs((lateral + axial) / stored - 1))
    assert abs(axial) > 0.05 * abs(stored)
    assert errors[1] < 2e-3
    assert errors[1] < errors[0]
