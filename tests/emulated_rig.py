"""A whole emulated rig in separate processes, and a raw client of its controller."""

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from importlib.resources import files

import psutil

from emulated import DEADLINE_S, until

START_S = 300.0  # the first run compiles the kernels, perhaps on a busy machine


def rig_file(folder, **replaced):
    """Write the emulated rig of the package with a free port and a link in the folder; return its path.

    replaced: new text by the old one.
    """
    text = (files("flexneedle.lab.rig") / "rigs" / "emulated.toml").read_text()
    for before, after in {
        # Other tests run beside this one: a reply may come after the default 100 ms.
        'address = "127.0.0.1:2323"': 'address = "127.0.0.1:0"\nreply_timeout_ms = 1000',
        "/tmp/aurora": str(folder / "aurora"),
        **replaced,
    }.items():
        assert before in text
        text = text.replace(before, after)
    path = folder / "rig.toml"
    path.write_text(text)
    return path


class EmulatedRig:
    """The processes and their messages; `ask` sends a line to the controller and returns its reply."""

    def __init__(self, process):
        self.process, self.messages, self._received, self._line = process, [], b"", None
        os.set_blocking(process.stdout.fileno(), False)
        until(lambda: self.message("ready") or process.poll() is not None, START_S)
        self.ready = self.message("ready")

    def message(self, key, **values):
        """Return the first message with a key and these values, None if there is none yet."""
        self._read()
        return next((m for m in self.messages if key in m and values.items() <= m.items()), None)

    def order(self, line):
        """Write an order; return the first message about it."""
        before = len(self.messages)
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()

        def answered():
            self._read()
            return [m for m in self.messages[before:] if "done" in m or "refused" in m]

        until(answered)
        return answered()[0]

    def ask(self, commands):
        """Send a line to the controller; return its reply."""
        if self._line is None:
            host, port = self.ready["ready"]["galil"].rsplit(":", 1)
            self._line = socket.create_connection((host, int(port)), timeout=DEADLINE_S)
        self._line.sendall(f"{commands}\r".encode())
        answer = b""
        while answer.count(b":") + answer.count(b"?") <= commands.count(";"):
            got = self._line.recv(4096)
            if not got:
                raise ConnectionResetError
            answer += got
        return answer.decode()

    def at_rest(self, letters):
        """Wait until these motors rest."""
        query = "MG " + ",".join(f"_BG{letter}" for letter in letters)
        until(lambda: not any(map(float, self.ask(query).strip(" \r\n:").split())))

    @property
    def children(self):
        """The child processes."""
        return [psutil.Process(pid) for pid in self.ready["pids"].values()]

    def end(self, how=signal.SIGINT):
        """End the processes; return exit status and errors."""
        if self._line is not None:
            self._line.close()
        if self.process.poll() is None:
            self.process.send_signal(how)
        self.process.wait(DEADLINE_S)
        self._read()
        errors = self.process.stderr.read().decode()
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            stream.close()
        return self.process.returncode, errors

    def _read(self):
        if self.process.stdout.closed:
            return
        try:
            while data := os.read(self.process.stdout.fileno(), 65_536):
                self._received += data
        except BlockingIOError:
            pass
        *lines, self._received = self._received.split(b"\n")
        self.messages += [json.loads(line) for line in lines]


def started(*arguments):
    """Start `flexneedle emulate rig` with these arguments; return it when it is ready."""
    command = [sys.executable, "-m", "flexneedle", "emulate", "rig", *map(str, arguments)]
    pipe = subprocess.PIPE
    return EmulatedRig(subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe))


@contextmanager
def emulated_rig(*arguments):
    """Run `flexneedle emulate rig` with these arguments until Ctrl-C, after which no process is left."""
    rig = started(*arguments)
    children = rig.children
    try:
        yield rig
    finally:
        code, errors = rig.end()
    assert code == 0, errors
    until(gone(children))


def gone(processes):
    """Return a function that returns whether all processes have ended."""
    return lambda: not any(one.is_running() and one.status() != psutil.STATUS_ZOMBIE for one in processes)
