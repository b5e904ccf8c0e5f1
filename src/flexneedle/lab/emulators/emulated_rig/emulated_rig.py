"""Parent of the processes of an emulated rig: it starts them, forwards orders to them, and ends them."""

import select
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from time import monotonic
from typing import Any, NoReturn, Self

import tomli_w

from flexneedle.errors import InputError, RunError
from flexneedle.lab.emulators import aurora_faults, fbgs
from flexneedle.lab.emulators.aurora_server import SerialPort
from flexneedle.lab.emulators.emulated_rig.fibre_part import address_of_fibre, section_of
from flexneedle.lab.emulators.emulated_rig.images_part import address_of_images, sections_of
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.motors_part import address_of
from flexneedle.lab.emulators.emulated_rig.tracker_part import port_of
from flexneedle.lab.emulators.faults import FaultKind, parse_fault, parse_order
from flexneedle.lab.emulators.galil import galil_server as galil
from flexneedle.lab.emulators.orders import Orders
from flexneedle.lab.igtl.settings import IgtlAddress
from flexneedle.lab.process import ChildProcess

DEVICES: Mapping[str, Mapping[str, FaultKind]] = {
    "aurora": aurora_faults.FAULTS,
    "galil": galil.FAULTS,
    "fbgs": fbgs.FAULTS,
}
"""Kinds of fault by device."""

_PHANTOM, _GALIL, _AURORA, _FBGS, _IGTL = "phantom", "galil", "aurora", "fbgs", "igtl"
_MODULES = {
    _PHANTOM: "phantom",
    _GALIL: "motors_part",
    _AURORA: "tracker_part",
    _FBGS: "fibre_part",
    _IGTL: "images_part",
}
_END_S = 3.0  # for a process to end by itself
_FOLLOW_S = 0.5  # a process that has lost another may end before it


def split_fault(given: str) -> tuple[str, str]:
    """Return device and text of `DEVICE:KIND…@…`. Raises InputError, also for a fault that the device lacks."""
    device, _, text = given.partition(":")
    if device not in DEVICES or not text:
        example = "galil:stall=A@5:2"
        raise InputError(
            f"--fault {given}: must be DEVICE:KIND[=DETAIL]@SECONDS[:DURATION], such as {example}"
        )
    parse_fault(text, DEVICES[device], f"{device}:")
    return device, text


def check_free(job: EmulationJob) -> None:
    """Check that the addresses, the tracker's path and the name of the rig file are free, before the phantom is made.

    Making the phantom takes long. Raises InputError if one of them cannot be used, RigError if one is invalid.
    """
    rig, fibre = job.rig, job.fibre
    with ExitStack() as stack:
        stack.enter_context(galil.TcpServer(*address_of(rig)))
        if fibre is not None:
            stack.enter_context(fbgs.FbgsServer(*address_of_fibre(rig, fibre)))
        IgtlAddress(*address_of_images(job)).require_free()
        stack.enter_context(SerialPort(Path(port_of(rig))))
    if job.save is not None and job.save.exists():
        raise InputError(f"{job.save}: already exists: choose another file, or remove it")


def rig_values(job: EmulationJob, addresses: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of the rig file with the addresses of the devices, and the sensors along the needle."""
    values = job.rig.model_dump(mode="json", exclude_unset=True)
    values["driver"]["address"], values["tracker"]["port"] = addresses[_GALIL], addresses[_AURORA]
    sensors = {one["name"]: one for one in values.get("sensor", ())}
    if job.fibre is not None:
        sensors[job.fibre.title] = section_of(job.fibre, addresses[_FBGS])
    if job.images:
        sensors |= {one["name"]: one for one in sections_of(job, addresses[_IGTL])}
    return values | ({"sensor": list(sensors.values())} if sensors else {})


class EmulatedRig:
    """Processes of an emulated rig. Use it as a context manager; within, all serve.

    say: called with each message, values by name. Raises InputError or RunError if a process cannot begin.
    """

    def __init__(self, job: EmulationJob, say: Callable[[Mapping[str, Any]], None]) -> None:
        self._job, self._say = job, say
        self._parts: dict[str, ChildProcess] = {}

    def __enter__(self) -> Self:
        check_free(self._job)
        from_motors, to_phantom = socket.socketpair()
        from_phantom, to_tracker = socket.socketpair()
        ends = {_PHANTOM: (from_motors, to_tracker), _GALIL: (to_phantom,), _AURORA: (from_phantom,)}
        for name, emulated in ((_FBGS, self._job.fibre is not None), (_IGTL, bool(self._job.images))):
            if emulated:
                from_needle, to_sensor = socket.socketpair()
                # Before the motors, whose records make the phantom send shapes.
                ends = {_PHANTOM: (*ends.pop(_PHANTOM), to_sensor), name: (from_needle,), **ends}
        try:
            addresses = {name: self._start(name, mine) for name, mine in ends.items()}
        except BaseException:
            self._end()
            raise
        finally:
            for end in chain.from_iterable(ends.values()):
                end.close()
        pids = {name: part.pid for name, part in self._parts.items()}
        ready = {name: addresses[name] for name in (*DEVICES, _IGTL) if name in addresses}
        if self._job.save is not None:
            with self._job.save.open("x", encoding="utf-8") as file:
                file.write(tomli_w.dumps(rig_values(self._job, ready)))
        self._say({"ready": ready, "pids": pids, "time_s": monotonic()})
        return self

    def __exit__(self, *_exception: object) -> None:
        self._end()

    def serve(self, orders: Orders) -> NoReturn:
        """Forward orders until interrupted. Raises RunError if a process ends."""
        channels = {part.channel.fileno(): name for name, part in self._parts.items()}
        while True:
            ready, _, _ = select.select([*channels, *orders.sources], [], [])
            for line in orders.read(ready):
                self._forward_order(line)
            for descriptor, name in channels.items():
                if descriptor in ready:
                    for message in self._receive(name):
                        self._say({"device": name, **message})

    def _start(self, name: str, ends: tuple[socket.socket, ...]) -> Any:
        """Start a process and wait until it is ready; return its report."""
        descriptors = tuple(end.fileno() for end in ends)
        part = self._parts[name] = ChildProcess(f"{__package__}.{_MODULES[name]}", descriptors=descriptors)
        part.channel.send(self._job)
        while True:
            for message in self._receive(name):
                if "ready" in message:
                    return message["ready"]

    def _forward_order(self, line: str) -> None:
        """Forward `fault DEVICE:KIND…` to its device, `clear` to all."""
        devices = [name for name in DEVICES if name in self._parts]
        if line.strip() == "clear":
            for name in devices:
                self._parts[name].channel.send("clear")
            return
        try:
            device, order = _split_order(line, devices)
        except InputError as error:
            self._say({"refused": line.strip(), "reason": str(error)})
            return
        self._parts[device].channel.send(order)

    def _receive(self, name: str) -> Iterator[Mapping[str, Any]]:
        """Yield the reports of a process that have arrived, or wait for one.

        Raises the error that it has reported, or RunError if it has ended.
        """
        part = self._parts[name]
        yield from _raise_failures(part)
        if part.channel.ended:
            name = self._first_to_fail(name)
            first = self._parts[name]
            while not first.channel.ended:
                yield from _raise_failures(first)
            raise RunError(f"the process of the {name} has ended with exit code {first.wait()}")

    def _first_to_fail(self, ended: str) -> str:
        """Return the process that has failed: this one, or another that made it end in good order."""
        if self._parts[ended].wait() != 0:
            return ended
        failed = (name for name, part in self._parts.items() if part.wait(_FOLLOW_S) not in (0, None))
        return next(failed, ended)

    def _end(self) -> None:
        """End all processes by closing their channels, and report their last messages."""
        for part in self._parts.values():
            part.channel.end_sending()
        for name, part in self._parts.items():
            part.end(_END_S)
            while not part.channel.ended:
                for message in part.channel.receive():
                    if "ended" in message:
                        self._say({"device": name, **message})
            part.close()


def _raise_failures(part: ChildProcess) -> Iterator[Mapping[str, Any]]:
    """Yield the reports of a process that have arrived, or wait for one. Raises the error that it has reported."""
    for message in part.channel.receive(None):
        if "failed" in message:
            kind = InputError if message["input"] else RunError
            raise kind(message["failed"])
        yield message


def _split_order(line: str, devices: Sequence[str]) -> tuple[str, str]:
    """Return device and order of `fault DEVICE:KIND…`. Raises InputError, also for a fault that the device lacks."""
    word, _, given = line.strip().partition(" ")
    device, _, text = given.strip().partition(":")
    if word != "fault" or device not in devices:
        raise InputError(
            f"{line.strip()}: must be fault DEVICE:KIND[=DETAIL][:DURATION], with DEVICE {' or '.join(devices)}, "
            "or clear"
        )
    order = f"fault {text}"
    parse_order(order, DEVICES[device], 0.0)
    return device, order
