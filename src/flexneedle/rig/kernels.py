"""The compiled kernels of the whole closed loop: those of the model and those of the virtual phantoms."""

from pathlib import Path

from flexneedle import mechanics
from flexneedle.mechanics.compile import compiled
from flexneedle.rig import phantom
from flexneedle.rig.phantom.draw import Truth
from flexneedle.rig.phantom.phantom import Phantom
from flexneedle.rig.phantom.plants import PLANTS
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.control import Control
from flexneedle.simulator.simulator import Simulator


def all_compiled() -> bool:
    """Whether the kernels of model and phantoms lie in the cache, so that a start takes no compilation."""
    return all(compiled(Path(str(part.__file__)).parent) for part in (mechanics, phantom))


def compile_kernels() -> None:
    """Compile all kernels, or load them from the cache, instead of waiting for it in the first call of each."""
    scenario = load_scenario("phantom")  # kernels are the same for every scenario
    simulator, still = Simulator(scenario, threads=1), Control().row()
    simulator.compile()
    simulator.replay(simulator.start(), still[None])
    for kind in PLANTS:
        Phantom(Truth(scenario), 1, kind).apply((0.0, 0.0, 0.0, 0.0, -1), 0.0)
