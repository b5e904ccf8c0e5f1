"""The kernels are compiled ahead of their first call, and no further kernel later."""

import fcntl
import subprocess
import sys
from contextlib import nullcontext

import pytest
from numba.core import config

from flexneedle.phantom import kernels, plants
from flexneedle.phantom.kernels import compile_kernels, find_uncompiled

EVERYTHING = """
import sys

import flexneedle
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.mechanics import rollout, shape
from flexneedle.phantom import equilibrium, rod, space
from flexneedle.phantom.plants import PLANTS
from flexneedle.phantom.kernels import compile_kernels, find_uncompiled

def signatures():
    parts = {"rollout": rollout, "shape": shape, "equilibrium": equilibrium, "rod": rod, "space": space}
    found = {f"{part}.{name}": value for part, module in parts.items() for name, value in vars(module).items()}
    return {name: len(value.signatures) for name, value in found.items() if hasattr(value, "signatures")}

preset, axes = sys.argv[1], int(sys.argv[2])
compile_kernels(axes)
before = signatures()
assert not find_uncompiled(axes)
entries = "rollout.rollout", "shape.equal_arc_nodes", "equilibrium.step", "rod._frames", "rod.tip_angles"
assert all(before[name] == 1 for name in entries), before
quick = {"samples": 16, "iterations": 2}
scenario = flexneedle.load_scenario(preset).with_values({
    **{f"plan.{key}": value for key, value in quick.items()},
    **{f"control.ce_mpc.{key}": value for key, value in quick.items()},
    "control.ce_mpc.horizon": 2, "setup.tip_to_skin_mm": 4.0, "target.depth_mm": 8.0, "target.lateral_mm": 0.5,
})
plans = [flexneedle.plan(scenario, strategy=strategy) for strategy in ("manipulation", "steering")]
for name in CONTROLLERS:
    for kind in PLANTS:
        flexneedle.insert(scenario, plans[0], controller=name, rig=flexneedle.VirtualRig(kind), force=True)
assert signatures() == before, (signatures(), before)
"""


@pytest.mark.long
@pytest.mark.parametrize(("preset", "axes"), [("phantom", 1), ("phantom3d", 2)])
def test_plans_and_insertions_compile_no_further_kernel(preset, axes):
    command = [sys.executable, "-c", EVERYTHING, preset, str(axes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and no kernels of the model and the plants to compile into it."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # for the second process
    monkeypatch.setattr(kernels, "Simulator", lambda _scenario, threads: Compiled())  # noqa: ARG005
    monkeypatch.setattr(plants, "PLANTS", ())
    return tmp_path


@pytest.fixture
def _one_process(monkeypatch):
    """Start no process that compiles the exact plant."""
    monkeypatch.setattr(kernels, "_compiling_exact_plant", nullcontext)


@pytest.mark.usefixtures("_one_process")
def test_kernels_are_compiled_for_their_sources_and_axes(cache, monkeypatch):
    """Kernels of the plane are not those in space."""
    assert [*find_uncompiled(1, 2)] == ["the plane", "space", "the exact phantom"]
    compile_kernels(1, phantoms=False)
    assert [*find_uncompiled(1, 2)] == ["space", "the exact phantom"]
    compile_kernels(1)
    assert [*find_uncompiled(1, 2)] == ["space"]
    monkeypatch.setattr(kernels, "cache_folder", lambda home: str(cache / home.name))
    assert [*find_uncompiled(1)] == ["the plane", "the exact phantom"]


@pytest.mark.usefixtures("_one_process", "cache")
def test_sources_written_again_are_not_compiled(monkeypatch):
    """Numba compares their time."""
    compile_kernels(1)
    monkeypatch.setattr(kernels, "source_stamp", lambda _home: "later")
    assert find_uncompiled(1)


@pytest.mark.usefixtures("cache")
def test_a_plan_compiles_no_phantom(monkeypatch):
    compiled = []
    exact = "exact, in a second process"
    monkeypatch.setattr(kernels, "_compiling_exact_plant", lambda: nullcontext(compiled.append(exact)))
    monkeypatch.setattr(kernels, "compile_plant", lambda _scenario, kind: compiled.append(kind))
    monkeypatch.setattr(plants, "PLANTS", ("exact", "model"))
    compile_kernels(1, phantoms=False)
    assert compiled == []
    compile_kernels(1)
    assert compiled == [exact, "exact", "model"]


@pytest.mark.usefixtures("_one_process")
def test_one_process_compiles_at_a_time(cache, monkeypatch):
    held = []

    def simulator(_scenario, threads):
        held.append((threads, is_locked(cache)))
        return Compiled()

    monkeypatch.setattr(kernels, "Simulator", simulator)
    compile_kernels(2)
    assert held == [(1, True)]
    assert not is_locked(cache)


@pytest.mark.long
def test_a_second_process_compiles_the_exact_plant(cache):
    compile_kernels(1)
    assert list(cache.rglob("equilibrium.step-*.nbc"))


class Compiled:
    """A simulator whose kernels are compiled."""

    def compile(self):
        """Do nothing."""


def is_locked(cache):
    """Return whether another opening of the file cannot take the lock."""
    (path,) = cache.rglob("lock")
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
