"""The model with the parameters of the fit, and its start."""

import numpy as np

from flexneedle.estimation.lateral import components, from_components
from flexneedle.estimation.prior import Priors, Slots
from flexneedle.mechanics.model import Adaptation
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import STILL, THETA, Floats, Y, Z

_REST = np.array([STILL])


def adapt_model(nominal: Simulator, settings: Priors, parameters: Floats) -> Simulator:
    """Return the model with these parameters (K,); nominal: the scenario's model, to which they refer."""
    layers, slots = len(nominal.scenario.tissue), Slots.of(nominal.scenario)
    shift = slots.modulus + layers
    variation = shift + layers - 1
    return nominal.with_adaptation(
        Adaptation(
            shift=parameters[shift:variation],
            stiffness=np.exp(parameters[slots.modulus : shift]),
            cell=settings.cell_mm,
            variation=np.exp(parameters[variation:]),
            bevel=float(parameters[slots.bevel]),
            bend=from_components(parameters[slots.bend]),
            clearance=float(parameters[slots.clearance]),
        )
    )


def settle_start(
    nominal: Simulator, model: Simulator, parameters: Floats, roll: float, axial: float
) -> State:
    """Return the state of the start, settled with these parameters (K,); axial: start error along the axis (mm).

    model: the model with the parameters; roll: of the needle before the first step (rad).
    """
    slots, start = Slots.of(nominal.scenario), nominal.start(roll)
    moved = start.with_estimate(
        base_x=float(start.base[0]) + axial,
        base=(start.base[Y : Z + 1] + components(parameters[slots.base])).tolist(),
        slope=(start.base[THETA:] + components(parameters[slots.slope])).tolist(),
    )
    return model.replay(moved, _REST)[0]
