"""Real-time priority of all threads of a process."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os
from threading import Event, Thread
from flexneedle.lab.rig.devices.priority import set_realtime_priority
end = Event()
threads = [Thread(target=end.wait)]
threads[0].start()
set_realtime_priority()
threads.append(Thread(target=end.wait))
threads[1].start()
print([os.sched_getscheduler(thread.native_id) for thread in threads], os.sched_getscheduler(0))
end.set()
"""


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no schedulers on this system")
def test_threads_that_run_already_have_it_too():
    permitted = "import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))"
    if subprocess.run([sys.executable, "-c", permitted], stderr=subprocess.DEVNULL).returncode:
        pytest.skip("real-time priority is not permitted here")
    found = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == f"[{os.SCHED_RR}, {os.SCHED_RR}] {os.SCHED_RR}"
