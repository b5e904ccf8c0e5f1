"""Compiled kernels of the closed loop: those of the model and of the virtual phantoms."""

from pathlib import Path

from flexneedle import mechanics
from flexneedle.mechanics.compile import compiled
from flexneedle.rig import phantom
from flexneedle.rig.phantom.draw import Truth
from flexneedle.rig.phantom.phantom import Phantom
from flexneedle.rig.phantom.plants import PLANTS
from flexneedle.scenario.files import load_scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL


def all_compiled() -> bool:
    """Whether the kernels of model and phantoms are in the cache, so that no compilation is needed."""
    return all(compiled(Path(str(part.__file__)).parent) for part in (mechanics, phantom))


def compile_kernels() -> None:
    """Compile all kernels, or load them from the cache, ahead of their first call."""
    scenario = load_scenario("phantom")  # kernels are the same for every scenario
    Simulator(scenario, threads=1).compile()
    for kind in PLANTS:
        Phantom(Truth(scenario), 0.0, kind).apply(STILL, 0.0)
