"""The page's worker as a process."""

import os

from flexneedle.lab.page.job_orders import JobChange, WorkerReady, WorkOrder
from flexneedle.lab.page.protocol import IterationMessage, JobMessage
from flexneedle.lab.process import ChildProcess
from page_clients import PATIENCE_S
from page_tasks import short

MODULE = "flexneedle.lab.page.worker"
_LONG = {"plan.samples": 2000, "plan.iterations": 500, "plan.max_iterations": 500}
"""A search of a minute, which is cancelled in the first iterations."""


def until(child, wanted):
    """Wait for a report."""
    while not child.channel.ended:
        for report in child.channel.receive(PATIENCE_S):
            if wanted(report):
                return
    raise AssertionError("the worker has ended")


def priority_of(child):
    return os.getpriority(os.PRIO_PROCESS, child.pid)


def test_beside_a_rig_it_has_a_lower_priority_cancels_within_a_plan_and_ends_with_its_channel():
    child = ChildProcess(MODULE, "plans-beside-a-rig")
    try:
        until(child, lambda report: isinstance(report, WorkerReady))
        assert priority_of(child) == min(os.nice(0) + 10, 19)
        for job in (1, 2):
            child.channel.send(WorkOrder("plan", "plan", job, scenario=short(**_LONG).values()))
            until(child, lambda report: isinstance(report, IterationMessage))
            if job == 1:
                child.channel.send(JobChange(1, cancel=True))
                until(child, lambda report: isinstance(report, JobMessage) and report.state == "cancelled")
        assert child.end(60.0) == 0
    finally:
        child.end(0.0)
        child.close()
