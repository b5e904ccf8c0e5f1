"""The oracle: the plan that knows the phantom of an insertion."""

from flexneedle import Plan, Scenario
from flexneedle.phantom.draw import Truth
from flexneedle.planning.planner import search_plan
from flexneedle.simulator.simulator import Simulator
from flexneedle.simulator.state import State
from flexneedle.types import STILL

_MOST = 5  # largest number of iterations of a search over its usual one


class TrueSimulator(Simulator):
    """Simulator with the parameters of a phantom, whose needle starts from the phantom's true start."""

    def __init__(self, truth: Truth, scenario: Scenario) -> None:
        super().__init__(scenario, threads=1)
        self._truth = truth

    def start(self, roll: float = 0.0) -> State:
        """Return the needle at its true start, rolled by `roll` (rad)."""
        state, truth = super().start(roll), self._truth
        _, y, z, theta, psi = state.base.tolist()
        moved = state.with_estimate(
            base=(y + truth.base_y, z + truth.base_z),
            slope=(theta + truth.base_turn, psi + truth.base_psi),
            tip_load=truth.load,
        )
        return self.step(moved, STILL)


def find_oracle(truth: Truth, strategy: str, samples: int, iterations: int, seed: int = 0) -> Plan:
    """Return the plan of the planner's search on the true model from the true start.

    samples, iterations: of each search, instead of the scenario's; as in a plan, a miss is searched again.
    """
    size = {"plan.samples": samples, "plan.iterations": iterations, "plan.max_iterations": _MOST * iterations}
    scenario = truth.scenario.with_values(size)
    simulator = TrueSimulator(truth, scenario)
    return search_plan(simulator, scenario.target.position, strategy, seed, lambda _: None)
