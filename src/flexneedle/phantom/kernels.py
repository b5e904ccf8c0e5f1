"""Compiled kernels of the closed loop, for the model and the virtual phantoms, in the plane or in space."""

import fcntl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from flexneedle import phantom
from flexneedle.mechanics.compile import cache_folder, source_stamp
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.phantom import Phantom
from flexneedle.phantom.plants import PLANTS
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL

_SCENARIOS = {1: "phantom", 2: "phantom3d"}
"""Lateral positions are real numbers in the plane and complex ones in space: the kernels are others, and in each the
same for every scenario."""


def all_compiled(axes: int) -> bool:
    """Return whether the kernels for scenarios with `setup.axes` are in the cache, so that no compilation is needed."""
    return _mark(axes).exists()


def compile_kernels(axes: int) -> None:
    """Compile all kernels for scenarios with `setup.axes`, or load them from the cache, ahead of their first call.

    One caller at a time: compiling in many processes at once is slow, and has crashed. The other callers load what the
    first has compiled.
    """
    scenario, mark = load_scenario(_SCENARIOS[axes]), _mark(axes)
    with _alone(mark.with_name("lock")):
        # The exact plant has the same kernels in the plane and in space.
        with nullcontext() if any(map(all_compiled, _SCENARIOS)) else _compiling_exact_plant():
            Simulator(scenario, threads=1).compile()
        for kind in PLANTS:
            compile_plant(scenario, kind)
        mark.touch()


def compile_plant(scenario: Scenario, kind: str) -> None:
    """Compile the kernels of a plant, or load them from the cache."""
    Phantom(Truth(scenario), 0.0, kind).apply(STILL, 0.0)


@contextmanager
def _compiling_exact_plant() -> Iterator[None]:
    """Compile the exact plant, half of the work, in a second process; if it fails, this one compiles later."""
    code = f"from {__name__} import compile_plant, load_scenario; compile_plant(load_scenario('phantom'), 'exact')"
    none = subprocess.DEVNULL
    with subprocess.Popen([sys.executable, "-c", code], stdin=none, stdout=none, stderr=none):
        yield


def _mark(axes: int) -> Path:
    """Return a file beside the kernels of the phantoms; names of folder and file change where Numba compiles again."""
    home = Path(str(phantom.__file__)).parent
    return Path(cache_folder(home)) / f"axes-{axes}-{source_stamp(home)}"


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
