"""A worker: `python -m flexneedle.lab.page.worker CHANNEL NAME [ADDRESS REGISTRATION]`, started by the page's server.

ADDRESS, REGISTRATION: of its insertions' connection to OpenIGTLink.

All workers are the same, except that `plans-beside-a-rig` has a lower priority.
"""

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping

from flexneedle.errors import FlexneedleError, ScenarioWarning, describe_error, one_line
from flexneedle.lab.page.job_orders import Action, WorkerReady
from flexneedle.lab.page.worker.igtl_link import IgtlLink
from flexneedle.lab.page.worker.insertion_jobs import InsertionJobs
from flexneedle.lab.page.worker.plan_jobs import estimate, needle, plan, warm_up
from flexneedle.lab.page.worker.reach_job import reach
from flexneedle.lab.page.worker.rig_insertion import check
from flexneedle.lab.page.worker.rig_retraction import retract
from flexneedle.lab.page.worker.study_jobs import ShownRows, list_rows
from flexneedle.lab.page.worker.task import Cancelled, TaskQueue, WorkerTask
from flexneedle.lab.process import open_channel
from flexneedle.record.folder import versions

Actions = Mapping[Action, Callable[[WorkerTask], None]]
_OPTIONS = 3
"""First argument of the connection to OpenIGTLink."""
_NICE = 10
"""Niceness of plans beside a rig, whose insertion has priority. Otherwise estimates are faster without it, above all
where the browser draws without a graphics processor."""
_MOST_WAITING = 1_000_000
"""Queued reports: none may be lost, since the rows of an insertion have no gaps."""


def main() -> int:
    """Carry out the orders of the server until its channel ends."""
    if "plans-beside-a-rig" in sys.argv:
        os.nice(_NICE)
    warnings.simplefilter("ignore", ScenarioWarning)  # the server reports them
    channel = open_channel(int(sys.argv[1]), most_waiting=_MOST_WAITING)
    tasks = TaskQueue(channel)
    warm_up()
    versions()  # read now, while the files are still those that were imported
    channel.send(WorkerReady())
    link, rows = IgtlLink(sys.argv[_OPTIONS:], channel.send), ShownRows()
    insertions = InsertionJobs(link)
    actions: Actions = {
        "needle": needle,
        "estimate": estimate,
        "plan": plan,
        "reach": reach,
        "read": rows.read,
        "study": list_rows,
        "row": rows.recompute,
        "insert": insertions.insert,
        "check": check,
        "retract": retract,
        "save": insertions.save,
        "save_row": rows.save,
    }
    while (task := tasks.next()) is not None:
        carry_out(task, actions)
        tasks.close(task)
    link.close()
    return 0


def carry_out(task: WorkerTask, actions: Actions) -> None:
    """Carry out an order, and report how it has ended."""
    try:
        task.control.check()
        actions[task.order.action](task)
    except Cancelled:
        task.report_job("cancelled")
    except FlexneedleError as error:
        task.report_job("failed", text=one_line(error))
    except Exception as error:  # noqa: BLE001  an error in one job must not end the worker
        traceback.print_exc()
        task.report_job("failed", text=describe_error(error))
    else:
        task.report_job("done", 1.0)


if __name__ == "__main__":
    sys.exit(main())
