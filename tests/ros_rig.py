"""Insertions in real time, in a separate process, which ROS nodes follow and stop; most on a rig in memory."""

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from time import monotonic

import tomli_w

import flexneedle
from emulated import DEADLINE_S, until
from flexneedle.lab.rig.devices.clock import WallClock
from flexneedle.scenario.files import dump_scenario
from flexneedle.types import Frame, SensorReading
from ros_peers import Peer
from stages import RIG, Stage

TESTS = Path(__file__).parent
PATIENCE_S = 300.0
START_MM = flexneedle.load_scenario("phantom").setup.start_tip_x
QUICK = {
    "target.depth_mm": 6.0,
    "target.lateral_mm": 0.0,
    "monitor.references": 0,
    "plan.samples": 16,
    "plan.iterations": 2,
    "plan.max_iterations": 2,
    "needle.nodes": 15,
    "phantom.element_mm": 5.0,
    "phantom.contact_spacing_mm": 2.0,
}


class Noting(Stage):
    """Motors in memory that write a line for each call that switches, moves or stops them: what, when, where."""

    made = None

    def __init__(self, file, channels):
        self._file = Path(file).open("a")  # noqa: SIM115  closed with the motors
        super().__init__(WallClock(), channels)
        Noting.made = self

    def _called(self, *call):
        super()._called(*call)
        if call[0] in ("power", "follow", "stop"):
            self._write(call[0])

    def _write(self, what):
        at = {channel: motor.position for channel, motor in self.motors.items()}
        self._file.write(f"{json.dumps([what, monotonic(), at])}\n")
        self._file.flush()

    def close(self):
        self._up_to_now()
        self._write("close")
        self._file.close()


def motors(settings, channels):
    """The driver `ros_rig:motors`. notes: the file of the lines."""
    return Noting(settings["notes"], channels)


class Tip:
    """The tracker `ros_rig:Tip`: the tip of a needle that no tissue bends."""

    status = "ok"

    def __init__(self, _settings, clock):
        self.clock, self.number = clock, 0

    def read(self):
        due = int(self.clock.now() * 40.0)
        if Noting.made is None or due <= self.number:
            return ()
        self.number = due
        x = START_MM + Noting.made.motors["A"].position / 1000.0
        noise = 1e-3 * (due % 7)
        return (Frame(self.clock.now(), due, {"tip": SensorReading((x, noise, 0.0))}),)

    def close(self):
        pass


def quick_scenario(folder):
    """Write a scenario that is planned and inserted quickly; return its path."""
    path = folder / "quick.toml"
    path.write_text(dump_scenario(flexneedle.load_scenario("phantom").with_values(QUICK)))
    return path


class Started:
    """An insertion in a separate process. `peer` makes its peers."""

    def __init__(self, folder, profile, *options, ros, on_rig=False):
        self.folder, self.profile, self.notes = folder, profile, folder / "notes"
        self.out = folder / "out"
        command = [sys.executable, "-m", "flexneedle", "insert", str(quick_scenario(folder)), "--force"]
        if ros is not None or on_rig:
            rig = folder / "memory.toml"
            parts = {"driver": {"kind": "ros_rig:motors", "notes": str(self.notes)}}
            parts |= {} if ros is None else {"ros": ros}
            rig.write_text(tomli_w.dumps(RIG | parts | {"tracker": {"kind": "ros_rig:Tip"}}))
            command += ["--rig", str(rig)]
        self.process = subprocess.Popen(
            [*command, "--out", str(self.out), *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=TESTS,
            start_new_session=True,
        )

    def peer(self, publish=("state",), subscribe=("stop",)):
        """A ROS node that the insertion's node has found on these topics."""
        peer = Peer(self.profile, publish=publish, subscribe=subscribe)

        def found():
            return all(one.writers for one in peer.readers.values()) and all(
                one.readers for one in peer.writers.values()
            )

        until(lambda: found() or self.over, PATIENCE_S)
        return peer

    @property
    def over(self):
        assert self.process.poll() is None, self.process.communicate()[1]
        return False

    def until_state(self, peer, state):
        """Wait until the rig reports a state."""
        self.await_that(lambda: state in [one.data for one in peer.received("state")])

    def await_that(self, condition):
        """Wait for a condition: the first insertion compiles, on a machine that may be busy."""

        def holds():
            if self.process.poll() is None:
                return condition()
            until(condition)  # what the process sent last is on its way
            return True

        until(holds, PATIENCE_S)

    def calls(self, *wanted):
        """The calls of the motors with these names: (what, when, where)."""
        lines = self.notes.read_text().splitlines() if self.notes.exists() else []
        return [call for call in map(json.loads, lines) if call[0] in wanted]

    def end(self, seconds=PATIENCE_S):
        """Wait for its end; return exit status, stdout and the lines of stderr."""
        out, errors = self.process.communicate(timeout=seconds)
        return self.process.returncode, out, errors.splitlines()

    def end_followed_by(self, peer):
        """The same, while a peer takes what is published."""
        until(lambda: list(map(peer.received, peer.readers)) and self.process.poll() is not None, PATIENCE_S)
        return self.end()

    @property
    def stored(self):
        """The values of `run.json`."""
        return json.loads((self.out / "run.json").read_text())


@contextmanager
def started(folder, profile, *options, ros=None, on_rig=False):
    """Start an insertion: on the rig in memory with a section `ros`; None: without it `on_rig`, else a
    virtual rig, or the rig of the options."""
    made = Started(folder, profile, *options, ros=ros, on_rig=on_rig)
    try:
        yield made
    finally:
        if made.process.poll() is None:
            os.killpg(made.process.pid, signal.SIGKILL)
            made.process.communicate(timeout=DEADLINE_S)
