"""The process that starts the three of an emulated rig, passes orders on to them, and ends them."""

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any, NoReturn, Self

from flexneedle.errors import InputError, RunError
from flexneedle.lab.emulators import aurora
from flexneedle.lab.emulators.emulated_rig.job import Job
from flexneedle.lab.emulators.emulated_rig.motors import address_of
from flexneedle.lab.emulators.emulated_rig.tracker import port_of
from flexneedle.lab.emulators.faults import FaultKind, parse_fault, parse_order
from flexneedle.lab.emulators.galil import server as galil
from flexneedle.lab.emulators.orders import Orders
from flexneedle.lab.emulators.server import Serial
from flexneedle.lab.processes import end_process
from flexneedle.lab.rig.rig_file import RigFile

DEVICES: Mapping[str, Mapping[str, FaultKind]] = {"aurora": aurora.FAULTS, "galil": galil.FAULTS}
"""Kinds of fault by device."""

_PHANTOM, _GALIL, _AURORA = "phantom", "galil", "aurora"
_MODULES = {_PHANTOM: "phantom", _GALIL: "motors", _AURORA: "tracker"}
_END_S = 3.0  # for a process to end by itself
_FOLLOW_S = 0.5  # a process that has lost another may end before it


def split_fault(given: str) -> tuple[str, str]:
    """Return device and text of `DEVICE:KIND…@…`. Raises InputError, also for a fault that the device has not."""
    device, _, text = given.partition(":")
    if device not in DEVICES or not text:
        example = "galil:stall=A@5:2"
        raise InputError(
            f"--fault {given}: must be DEVICE:KIND[=DETAIL]@SECONDS[:DURATION], such as {example}"
        )
    parse_fault(text, DEVICES[device], f"{device}:")
    return device, text


def check_free(rig: RigFile) -> None:
    """Raise InputError if the address of the controller or the path of the tracker cannot be used, RigError for one
    that is none: found out here, before the phantom is made, which takes long.
    """
    with galil.Tcp(*address_of(rig)), Serial(Path(port_of(rig))):
        pass


@dataclass
class _Part:
    """One of the processes, and what it has reported of a line."""

    name: str
    process: subprocess.Popen[bytes]
    received: bytes = b""
    ended: bool = False

    @property
    def output(self) -> int:
        """Descriptor of its reports."""
        return _descriptor(self.process.stdout)

    def read(self) -> list[Mapping[str, Any]]:
        """The reports that have arrived; waits for one. At their end `ended` is set."""
        data = os.read(self.output, 65_536)
        self.ended = not data
        *lines, self.received = (self.received + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def order(self, line: str) -> None:
        """Send it a line. One that has ended is noticed by its reports."""
        with suppress(BrokenPipeError):
            os.write(_descriptor(self.process.stdin), f"{line}\n".encode())


def _descriptor(stream: Any) -> int:
    if stream is None:
        raise RunError("a process of the rig has no pipe")
    return int(stream.fileno())


class EmulatedRig:
    """The processes of an emulated rig. Use it as a context manager; within, all three serve.

    say: called with each message, values by name. Raises InputError or RunError if a process cannot begin.
    """

    def __init__(self, job: Job, say: Callable[[Mapping[str, Any]], None]) -> None:
        self._job, self._say = job, say
        self._parts: dict[str, _Part] = {}

    def __enter__(self) -> Self:
        check_free(self._job.rig)
        from_motors, to_phantom = os.pipe()
        from_phantom, to_tracker = os.pipe()
        ends = {_PHANTOM: (from_motors, to_tracker), _GALIL: (to_phantom,), _AURORA: (from_phantom,)}
        try:
            addresses = {name: self._started(name, mine) for name, mine in ends.items()}
        except BaseException:
            self._end()
            raise
        finally:
            for end in (from_motors, to_phantom, from_phantom, to_tracker):
                os.close(end)
        pids = {name: part.process.pid for name, part in self._parts.items()}
        ready = {name: addresses[name] for name in (_GALIL, _AURORA)}
        self._say({"ready": ready, "pids": pids, "time_s": monotonic()})
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._end()

    def serve(self, orders: Orders) -> NoReturn:
        """Pass orders on until interrupted. Raises RunError if a process ends."""
        while True:
            outputs = [part.output for part in self._parts.values()]
            ready, _, _ = select.select([*outputs, *orders.sources], [], [])
            for line in orders.read(ready):
                self._order(line)
            for part in self._parts.values():
                if part.output in ready:
                    self._take(part)

    def _started(self, name: str, descriptors: tuple[int, ...]) -> Any:
        """Start a process and wait until it is ready; return what it reports then."""
        module = f"{__package__}.{_MODULES[name]}"
        command = [sys.executable, "-m", module, *map(str, descriptors)]
        # A session of its own, so that Ctrl-C reaches only this process, which then ends it.
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=descriptors,
            start_new_session=True,
        )
        part = self._parts[name] = _Part(name, process)
        part.order(self._job.to_line())
        while True:
            for message in self._messages(part):
                if "ready" in message:
                    return message["ready"]

    def _order(self, line: str) -> None:
        """Pass on `fault DEVICE:KIND…` to its device, `clear` to both."""
        if line.strip() == "clear":
            for name in DEVICES:
                self._parts[name].order("clear")
            return
        try:
            device, order = _split_order(line)
        except InputError as error:
            self._say({"refused": line.strip(), "reason": str(error)})
            return
        self._parts[device].order(order)

    def _take(self, part: _Part) -> None:
        for message in self._messages(part):
            self._say({"device": part.name, **message})

    def _messages(self, part: _Part) -> Iterator[Mapping[str, Any]]:
        """The reports of a process. Raises the error that it has reported, or RunError if it has ended."""
        yield from _without_failure(part)
        if part.ended:
            first = self._first_to_fail(part)
            while not first.ended:
                yield from _without_failure(first)
            code = first.process.returncode
            raise RunError(f"the process of the {first.name} has ended with exit code {code}")

    def _first_to_fail(self, ended: _Part) -> _Part:
        """The process that has failed: this one, or the one with which it has ended in good order."""
        if ended.process.wait() != 0:
            return ended
        for part in self._parts.values():
            with suppress(subprocess.TimeoutExpired):
                if part.process.wait(_FOLLOW_S) != 0:
                    return part
        return ended

    def _end(self) -> None:
        """End all processes by closing their inputs, and report what they report then."""
        for part in self._parts.values():
            if part.process.stdin is not None:
                part.process.stdin.close()
        for part in self._parts.values():
            end_process(part.process, _END_S)
            self._last_words(part)

    def _last_words(self, part: _Part) -> None:
        while not part.ended:
            for message in part.read():
                if "ended" in message:
                    self._say({"device": part.name, **message})
        if part.process.stdout is not None:
            part.process.stdout.close()


def _without_failure(part: _Part) -> Iterator[Mapping[str, Any]]:
    """The reports of a process that have arrived; waits for one. Raises the error that it has reported."""
    for message in part.read():
        if "failed" in message:
            kind = InputError if message["input"] else RunError
            raise kind(message["failed"])
        yield message


def _split_order(line: str) -> tuple[str, str]:
    """Device and order of `fault DEVICE:KIND…`. Raises InputError, also for a fault that the device has not."""
    word, _, given = line.strip().partition(" ")
    device, _, text = given.strip().partition(":")
    if word != "fault" or device not in DEVICES:
        raise InputError(
            f"{line.strip()}: must be fault DEVICE:KIND[=DETAIL][:DURATION], with DEVICE {' or '.join(DEVICES)}, "
            "or clear"
        )
    order = f"fault {text}"
    parse_order(order, DEVICES[device], 0.0)
    return device, order
