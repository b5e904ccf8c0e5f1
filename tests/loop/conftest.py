"""Insertions shared by several tests, each executed once."""

from functools import cache

import pytest

import flexneedle
from flexneedle.control.controllers import DEFAULT
from insertions import PHANTOM, RecordedPhantom, run


@pytest.fixture(scope="session")
def plan():
    return flexneedle.plan(PHANTOM, (20.0, 3.0), seed=1)


@pytest.fixture(scope="session")
def real(plan):
    """An insertion by the default controller with undelayed readings, and the record of its tracker."""
    recorded = RecordedPhantom(plan.roll)
    return run(plan, recorded.rig(), controller=DEFAULT), recorded


@pytest.fixture(scope="session")
def quick(plan):
    """An insertion as `real` by a quick controller, for replays that any controller can serve."""
    recorded = RecordedPhantom(plan.roll)
    return run(plan, recorded.rig()), recorded


@pytest.fixture(scope="session")
def late(plan):
    """An insertion as `quick` with readings delayed by a control period."""
    recorded = RecordedPhantom(plan.roll, delay=0.2)
    return run(plan, recorded.rig()), recorded


@pytest.fixture(scope="session")
def inserted(plan):
    """Return the insertion of a seed in the virtual rig; each variant is executed once."""

    @cache
    def insert(seed, phantom="exact", controller=DEFAULT, threads=None, **values):
        scenario = PHANTOM.with_values({key.replace("__", "."): value for key, value in values.items()})
        rig = flexneedle.VirtualRig(phantom)
        return flexneedle.insert(scenario, plan, seed, rig=rig, controller=controller, threads=threads)

    return insert
