"""Compiled kernels of the closed loop, for the model and the virtual phantoms, in the plane or in space."""

import fcntl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from flexneedle import phantom
from flexneedle.mechanics.compile import cache_folder, source_stamp
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import STILL

_SCENARIOS = {1: "phantom", 2: "phantom3d"}
"""Lateral positions are real numbers in the plane and complex ones in space: the kernels are others, and in each the
same for every scenario. The exact plant has the same kernels in the plane and in space."""
_MODEL, _EXACT = {1: "the plane", 2: "space"}, "the exact phantom"
_SECONDS = {"the plane": 15.0, "space": 15.0, _EXACT: 15.0}


def find_uncompiled(*axes: int, phantoms: bool = True) -> dict[str, float]:
    """Return names of the kernels that are not in the cache, with the time (s) to compile them on an idle core.

    axes: values of `setup.axes`; phantoms: include the virtual phantoms.
    """
    names = [_MODEL[each] for each in axes] + [_EXACT] * phantoms
    return {name: _SECONDS[name] for name in names if not _mark(name).exists()}


def compile_kernels(axes: int, *, phantoms: bool = True) -> None:
    """Compile the kernels for scenarios with `setup.axes`, or load them from the cache, ahead of their first call.

    phantoms: compile the virtual phantoms too, which a plan without zones does not need. One caller at a time:
    compiling in many processes at once is slow, and has crashed. The other callers load what the first has compiled.
    """
    scenario = load_scenario(_SCENARIOS[axes])
    with _alone(_mark("").with_name("lock")):
        with _compiling_exact_plant() if _EXACT in find_uncompiled(phantoms=phantoms) else nullcontext():
            Simulator(scenario, threads=1).compile()
            _mark(_MODEL[axes]).touch()
        if phantoms:
            from flexneedle.phantom.plants import PLANTS

            for kind in PLANTS:
                compile_plant(scenario, kind)
            _mark(_EXACT).touch()


def compile_plant(scenario: Scenario, kind: str) -> None:
    """Compile the kernels of a plant, or load them from the cache."""
    from flexneedle.phantom.draw import Truth  # here, since a plan needs no plant
    from flexneedle.phantom.phantom import Phantom

    Phantom(Truth(scenario), 0.0, kind).apply(STILL, 0.0)


@contextmanager
def _compiling_exact_plant() -> Iterator[None]:
    """Compile the exact plant, half of the work, in a second process; if it fails, this one compiles later."""
    code = f"from {__name__} import compile_plant, load_scenario; compile_plant(load_scenario('phantom'), 'exact')"
    none = subprocess.DEVNULL
    with subprocess.Popen([sys.executable, "-c", code], stdin=none, stdout=none, stderr=none):
        yield


def _mark(name: str) -> Path:
    """Return a file beside the kernels of the phantoms; names of folder and file change where Numba compiles again."""
    home = Path(str(phantom.__file__)).parent
    return Path(cache_folder(home)) / f"{name.replace(' ', '-')}-{source_stamp(home)}"


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
