"""A signal that comes while a kernel runs raises its error after it; the process does not crash."""

import subprocess
import sys

PROGRAM = """
import os, signal, time
from threading import Timer
import numpy as np
import flexneedle

simulator = flexneedle.Simulator("phantom", threads=1)
controls = np.zeros((400, 70, 9))
controls[:, :, 0] = 1.0
start, few = simulator.start(), 0
simulator.rollout(start, controls[:2])
for number in range(8):
    timer = Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        simulator.rollout(start, controls)
        time.sleep(1.0)
    except KeyboardInterrupt:
        few += 1
    timer.join()
    try:
        for _ in range(10_000):
            simulator.step(start, flexneedle.Control(db_x=1.0))
            if _ == 20:
                os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        few += 1
print(few)
"""


def test_ctrl_c_within_a_kernel_does_not_crash_the_process():
    program = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n" + PROGRAM
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "16\n"), ended.stderr
