"""Insertions shared by several tests, each executed once."""

from functools import cache

import pytest

import flexneedle
import flexneedle.control
from insertions import (
    PHANTOM,
    Stage,
    Tank,
    loop,
    lost,
    run,
    spoilt_tape,
)


@pytest.fixture(scope="session")
def plan():
    return flexneedle.plan(PHANTOM, (20.0, 3.0), seed=1)


@pytest.fixture(scope="session")
def real(plan):
    """An insertion with a phantom and undelayed readings, and the record of its tracker."""
    tank = Tank(plan.roll)
    return run(plan, tank.rig()), tank


@pytest.fixture(scope="session")
def late(plan):
    """The same with readings delayed by a control period."""
    tank = Tank(plan.roll, delay=0.2)
    return run(plan, tank.rig()), tank


@pytest.fixture(scope="session")
def replayed(plan, real):
    """A replay of `real` without its phantom: only readings and applied commands."""
    tank = real[1]
    return run(plan, Stage(tank.tape, tank.applied).rig())


@pytest.fixture(scope="session")
def thinned(plan, real):
    """A replay of `real` without one reading of every batch."""
    tank = real[1]
    return run(plan, Stage(loop(spoilt_tape(tank.tape, 1, lost)), tank.applied).rig())


@pytest.fixture(scope="session")
def inserted(plan):
    """Return the insertion of a seed in the virtual rig; each variant is executed once."""

    @cache
    def insert(seed, phantom="exact", controller="adaptive-mpc", threads=None, **values):
        scenario = PHANTOM.with_values({key.replace("__", "."): value for key, value in values.items()})
        return flexneedle.insert(
            scenario, plan, seed, rig=flexneedle.VirtualRig(phantom), controller=controller, threads=threads
        )

    return insert
