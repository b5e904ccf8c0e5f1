"""A worker: `python -m flexneedle.lab.page.worker plans`, `plans-beside-a-rig` or `insertion`, started by the page
server. All do the same; the name shows in a list of processes.
"""

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import BinaryIO

from flexneedle.errors import FlexneedleError, ScenarioWarning, describe_error, one_line
from flexneedle.lab.page import channel
from flexneedle.lab.page.orders import Do, Ready
from flexneedle.lab.page.worker.inbox import Inbox
from flexneedle.lab.page.worker.insertion import Insertions
from flexneedle.lab.page.worker.needle import needle
from flexneedle.lab.page.worker.outbox import Outbox
from flexneedle.lab.page.worker.plans import estimate, plan
from flexneedle.lab.page.worker.reach import reach
from flexneedle.lab.page.worker.rig import check
from flexneedle.lab.page.worker.signals import Cancelled
from flexneedle.lab.page.worker.study import Rows, rows
from flexneedle.lab.page.worker.task import Task
from flexneedle.lab.page.worker.warm import warm_up

Actions = Mapping[Do, Callable[[Task], None]]
_NICE = 10
"""Niceness of plans beside a rig, so that its insertion has the processor first. Otherwise estimates are shown sooner
without it, above all where the browser draws without a graphics processor."""


def main() -> int:
    """Do the orders on stdin until it ends; report on stdout."""
    if "plans-beside-a-rig" in sys.argv[1:]:
        os.nice(_NICE)
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what anything prints is no message
    warnings.simplefilter("ignore", ScenarioWarning)  # the page has them from the server
    inbox, outbox = Inbox(os.fdopen(os.dup(0), "rb")), Outbox(partial(_write, out))
    warm_up()
    _write(out, channel.packed(Ready().model_dump_json()))
    insertions, again = Insertions(), Rows()
    actions: Actions = {
        "needle": needle,
        "estimate": estimate,
        "plan": plan,
        "reach": reach,
        "read": again.read,
        "study": rows,
        "row": again.row,
        "insert": insertions.insert,
        "check": check,
        "save": insertions.save,
        "save_row": again.save,
    }
    while (order := inbox.next()) is not None:
        carry_out(Task(*order, outbox), actions)
        outbox.flush()
        inbox.done(order[0])
    return 0


def _write(out: BinaryIO, data: bytes) -> None:
    out.write(data)
    out.flush()


def carry_out(task: Task, actions: Actions) -> None:
    """Do an order, and report how it has ended."""
    try:
        task.signals.check()
        actions[task.work.do](task)
    except Cancelled:
        task.tell("cancelled")
    except FlexneedleError as error:
        task.tell("failed", text=one_line(error))
    except Exception as error:  # noqa: BLE001 - whatever one job raises, the worker does the next
        traceback.print_exc()
        task.tell("failed", text=describe_error(error))
    else:
        task.tell("done", 1.0)


if __name__ == "__main__":
    sys.exit(main())
