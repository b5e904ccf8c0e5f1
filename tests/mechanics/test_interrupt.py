"""A signal during a kernel raises its error after the kernel; the process does not crash."""

import subprocess
import sys

PROGRAM = """
import os, signal
from threading import Timer
import numpy as np
import flexneedle

simulator = flexneedle.Simulator("phantom", threads=1)
controls = np.zeros((100, 70, 9))
controls[:, :, 0] = 1.0
start, caught = simulator.start(), 0
simulator.rollout(start, controls[:2])
for _ in range(3):
    timer = Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        simulator.rollout(start, controls)
        signal.pause()
    except KeyboardInterrupt:
        caught += 1
    timer.join()
    try:
        for step in range(10_000):
            simulator.step(start, flexneedle.Control(db_x=1.0))
            if step == 20:
                os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        caught += 1
print(caught)
"""


def test_ctrl_c_within_a_kernel_does_not_crash_the_process():
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n" + PROGRAM
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "6\n"), ended.stderr
