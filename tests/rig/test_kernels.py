"""The kernels are compiled ahead of their first call, and never later."""

import subprocess
import sys

import pytest

from flexneedle import mechanics
from flexneedle.rig import kernels, phantom

EVERYTHING = """
import flexneedle
from flexneedle.control.methods import METHODS
from flexneedle.mechanics import insertion, shape
from flexneedle.rig.phantom import equilibrium
from flexneedle.rig.phantom.plants import PLANTS
from flexneedle.rig.kernels import all_compiled, compile_kernels

def signatures():
    parts = {"insertion": insertion, "shape": shape, "equilibrium": equilibrium}
    found = {f"{part}.{name}": value for part, module in parts.items() for name, value in vars(module).items()}
    return {name: len(value.signatures) for name, value in found.items() if hasattr(value, "signatures")}

compile_kernels()
before = signatures()
assert all_compiled()
entries = "insertion._settle", "insertion._rollout", "insertion.energies", "shape.equal_arc_nodes", "equilibrium.step"
assert all(before[name] == 1 for name in entries), before
quick = {"samples": 16, "iterations": 2}
scenario = flexneedle.load_scenario("phantom").with_values({
    **{f"plan.{key}": value for key, value in quick.items()},
    **{f"control.ce_mpc.{key}": value for key, value in quick.items()},
    "control.ce_mpc.horizon": 2, "setup.tip_to_skin_mm": 4.0, "target.depth_mm": 8.0, "target.lateral_mm": 0.5,
})
plans = [flexneedle.plan(scenario, strategy=strategy) for strategy in ("manipulation", "steering")]
for name in METHODS:
    for kind in PLANTS:
        flexneedle.insert(scenario, plans[0], controller=name, phantom=kind, force=True)
assert signatures() == before, (signatures(), before)
"""


@pytest.mark.long
def test_plans_and_insertions_compile_no_further_kernel():
    command = [sys.executable, "-c", EVERYTHING]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("missing", [mechanics, phantom])
def test_all_compiled_needs_the_kernels_of_model_and_phantoms(monkeypatch, missing):
    monkeypatch.setattr(kernels, "compiled", lambda home: str(home) not in str(missing.__file__))
    assert not kernels.all_compiled()
    monkeypatch.setattr(kernels, "compiled", lambda _home: True)
    assert kernels.all_compiled()
