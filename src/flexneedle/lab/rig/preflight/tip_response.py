"""Motion of the tip of a needle in air for a motion of each axis."""

import numpy as np

from flexneedle.estimation.axial import carry_out
from flexneedle.lab.rig.axis_columns import AxisColumns
from flexneedle.lab.rig.preflight.fit import axis_stretch
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import Control, Floats, Z

_STEP_MM = 0.1
_ACROSS = {"guide_y": 1, "guide_z": 2, "base_y": 1, "base_z": 2}


def air_responses(rig: RigFile, scenario: Scenario | None, tip_x: float = 0.0) -> dict[str, Floats]:
    """Return the motion of the tip (3,) for 1 mm of each linear axis of a rig.

    With a scenario by its model, with the tip at `tip_x` (mm) as far as that is in air: the guide and the lateral base
    turn the needle about each other, so that the tip moves by more or less than they do. Without one only the
    insertion and the direction of the guide are known: the guide has 1 mm, the lateral base none.
    """
    if scenario is None:
        known = [name for name, _ in rig.axes.items() if name == "insertion" or name.startswith("guide")]
        return {name: np.eye(3)[_ACROSS.get(name, 0)] for name in known}
    space = scenario if scenario.setup.axes == 2 else None
    columns, simulator = AxisColumns(scenario.entry.slope), Simulator(scenario)
    state = simulator.start()
    ahead = min(tip_x, 0.0) - scenario.setup.start_tip_x
    if abs(ahead) > _STEP_MM:
        state = carry_out(simulator, state, Control(db_x=ahead))
    found = {"insertion": _direction(scenario)}
    for name, column in _ACROSS.items():
        if name not in dict(rig.axes.items()) or (name.startswith("guide") and not scenario.setup.has_guide):
            continue
        # The needle is alike to all sides: in the plane z is turned from y.
        twin = name if space else name.replace("_z", "_y")
        moved = carry_out(simulator, state, columns.to_control({twin: _STEP_MM}, 0.0, 0.0)).tip - state.tip
        response = moved[: Z + 1] / _STEP_MM
        found[name] = response if twin == name else np.eye(3)[column] * response[1]
    return found


def _direction(scenario: Scenario) -> Floats:
    """Return the direction (3,) of the insertion axis."""
    slope = scenario.entry.slope
    direction: Floats = np.array([1.0, slope.real, slope.imag]) / axis_stretch(slope)
    return direction
