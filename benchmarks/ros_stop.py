"""Time from a stop on a ROS topic to the stop of the motors: python benchmarks/ros_stop.py [--stops N] [--json].

A ROS node in a separate process publishes a stop while an axis of a rig in memory moves. Between them are the node of
the insertion, the controller's process, which forwards the stop, and the supervisor. Measured is the time from the
publication to the call that stops the motors, while the controller waits, and while it plans on all cores, and how far
the axis then moved. DDS is kept on the loopback interface.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

import numpy as np
from measuring import LOOPBACK, parser_of, quantiles, show

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import flexneedle
from flexneedle.errors import StoppedError
from flexneedle.geometry.rigid import identity
from flexneedle.lab.rig.rig_file import RigFile, RosSettings
from flexneedle.lab.rig.supervised import Tick
from flexneedle.lab.rig.supervisor.client import SupervisorClient
from flexneedle.lab.rig.supervisor.protocol import SupervisorTask
from flexneedle.lab.ros.bridge import Bridge
from flexneedle.lab.ros.dds import TopicWriter, join_domain
from flexneedle.lab.ros.profile import load_profile
from flexneedle.scenario.sections.monitor import MonitorSettings
from stages import RIG

HERE = Path(__file__).resolve()
TESTS = HERE.parents[1] / "tests"
SPEED_MM_S, FAR_MM = 5.0, 100.0
SUBSCRIBED = load_profile("neutral").subscribe


def main() -> int:
    """Run the measurements and print them."""
    parser = parser_of(__doc__)
    parser.add_argument("--stops", type=int, default=200)
    parser.add_argument("--publisher", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
    os.environ.setdefault("ROS_DOMAIN_ID", str(40 + os.getpid() % 150))
    if args.publisher:
        return publish()
    os.chdir(TESTS)  # where the supervisor finds the motors
    show(measure(args.stops), as_json=args.json)
    return 0


def measure(count: int) -> dict[str, dict[str, float]]:
    """All measurements, with one rig and one node."""
    with tempfile.TemporaryDirectory() as folder:
        notes = Path(folder) / "notes"
        parts = {
            "driver": {"kind": "ros_rig:motors", "notes": str(notes)},
            "tracker": {"kind": "stages:Still"},
        }
        rig = RigFile.model_validate(RIG | parts)
        task = SupervisorTask(rig, time.monotonic(), 2, MonitorSettings(references=0), identity(), 0.0, 0.3)
        command = [sys.executable, HERE, "--publisher"]
        with (
            Bridge(RosSettings()) as bridge,
            SupervisorClient(task, lambda one: bridge(Tick(one))) as supervisor,
        ):
            bridge.confirm(supervisor)
            other = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            if not other.stdout.readline():
                raise SystemExit("the nodes have not found each other")
            rng = np.random.default_rng(0)
            waiting = _stops(supervisor, other, notes, count, rng)
            with _planning():
                busy = _stops(supervisor, other, notes, count, rng)
            other.communicate()
    return {
        f"{count} stops while the controller waits": waiting,
        f"{count} stops while it plans": busy,
    }


def _stops(
    supervisor: SupervisorClient,
    other: subprocess.Popen[str],
    notes: Path,
    count: int,
    rng: np.random.Generator,
) -> dict[str, float]:
    taken = []
    for _ in range(count):
        supervisor.arm()
        supervisor.move_to("insertion", 0.0)
        before = len(notes.read_text().splitlines())
        other.stdin.write(f"stop true {rng.uniform(0.2, 0.3)}\n")
        other.stdin.flush()
        try:
            supervisor.move_to("insertion", FAR_MM, SPEED_MM_S)
        except StoppedError:
            supervisor.stop()
            supervisor.reset()
        else:
            raise SystemExit("not stopped")
        sent = float(other.stdout.readline())
        lines = [json.loads(line) for line in notes.read_text().splitlines()[before:]]
        taken.append(next(at for what, at, _ in lines if what == "stop") - sent)
    return quantiles("to the stop of the motors", taken)


@contextmanager
def _planning() -> Iterator[None]:
    """Plan again and again in a thread, as a controller does."""
    ended, scenario = Event(), flexneedle.load_scenario("phantom")

    def plan() -> None:
        while not ended.is_set():
            flexneedle.plan(scenario)

    thread = Thread(target=plan)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def publish() -> int:
    """Publish for each line KEY VALUE SECONDS of the standard input, such as `stop true 0.2`; print when.

    KEY: stop or arm; VALUE: true or false; SECONDS: to wait before. Times are in s on the monotonic clock.
    """
    import rosbags.typesys.stores.ros2_humble as messages

    domain = join_domain()
    writers = {
        key: TopicWriter(domain, getattr(SUBSCRIBED, key).topic, "std_msgs/msg/Bool")
        for key in ("stop", "arm")
    }
    deadline = time.monotonic() + 30.0
    # The node has a third reader of stops, for latched ones.
    while writers["stop"].readers < 2 or writers["arm"].readers < 1:
        if time.monotonic() > deadline:
            return 1
        time.sleep(0.01)
    print("ready", flush=True)
    for line in sys.stdin:
        key, value, seconds = line.split()
        message = messages.std_msgs__msg__Bool(value == "true")
        time.sleep(float(seconds))
        begun = time.monotonic()
        writers[key].write(message)
        print(begun, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
