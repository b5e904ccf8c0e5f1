"""What the processes of an emulated rig are started with, and what they report: lines of JSON on stdin and stdout."""

import json
import os
import sys
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, Self

from flexneedle.errors import FlexneedleError, InputError, RigError, one_line
from flexneedle.lab.emulators.emulated_rig.axes import carriages_of
from flexneedle.lab.emulators.emulated_rig.stream import StreamEnded
from flexneedle.lab.emulators.faults import Schedule
from flexneedle.lab.emulators.orders import Orders
from flexneedle.lab.rig.rig_file import RigFile
from flexneedle.planning.origin import check_origin, placed
from flexneedle.scenario.model import Scenario
from flexneedle.types import Insertion, Plan


@dataclass(frozen=True)
class Job:
    """A rig, the scenario of its phantom, the seed of what is drawn, and the file of the true states or None.

    faults: texts of scheduled faults by device, "aurora" or "galil".
    """

    rig: RigFile
    scenario: Scenario
    seed: int = 0
    truth: Path | None = None
    faults: tuple[tuple[str, str], ...] = ()

    def faults_of(self, device: str) -> list[str]:
        """Texts of the scheduled faults of a device."""
        return [text for name, text in self.faults if name == device]

    def to_line(self) -> str:
        """The job in one line of JSON."""
        values = {
            "rig": self.rig.model_dump(mode="json", exclude_none=True),
            "scenario": self.scenario.values(),
            "seed": self.seed,
            "truth": None if self.truth is None else str(self.truth),
            "faults": self.faults,
        }
        return json.dumps(values)

    @classmethod
    def of_line(cls, line: str) -> Self:
        """The job of a line."""
        values = json.loads(line)
        return cls(
            RigFile.model_validate(values["rig"]),
            Scenario.from_values(values["scenario"]),
            values["seed"],
            None if values["truth"] is None else Path(values["truth"]),
            tuple((name, text) for name, text in values["faults"]),
        )


def checked_job(
    rig: RigFile,
    scenario: Scenario,
    record: object,
    seed: int,
    truth: Path | None,
    faults: tuple[tuple[str, str], ...],
) -> Job:
    """Return the job of a rig, a scenario, and the record of a plan, of an insertion or None.

    Raises InputError if it cannot be emulated: devices of another kind, a tracker in an environment, an entry that is
    free without a plan, several plans, or one of another scenario; RigError for axes that the phantom cannot have.
    """
    for part, kind in (("driver", "galil"), ("tracker", "aurora")):
        if (given := getattr(rig, part).kind) != kind:
            raise RigError(f"{part}.kind = {given!r}: must be {kind!r} to be emulated")
    if scenario.tracker.environment is not None:
        raise InputError("tracker.environment: the emulated tracker has white noise only; leave it out")
    plan = record.plan if isinstance(record, Insertion) else record
    if isinstance(plan, Plan):
        scenario = placed(scenario, plan)
        check_origin(plan, scenario)
    elif plan is not None:
        raise InputError(
            "--plan: the folder has several plans; make one with flexneedle plan --strategy NAME"
        )
    elif scenario.entry.free:
        raise InputError(
            "entry: the plan chooses it (free_radius_mm, free_slope_mrad); give the plan with --plan"
        )
    carriages_of(rig.axes, scenario)
    return Job(rig, scenario, seed, truth, faults)


class Lifeline(Orders):
    """Orders of the process that has started this one. They end with it, even if it is killed.

    others: further descriptors to wait for, with a function that reads them.
    """

    def __init__(
        self, source: int, others: Sequence[int] = (), take: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(source)
        self._others, self._take = list(others), take

    @property
    def sources(self) -> list[int]:
        """The descriptors to wait for."""
        return [*super().sources, *self._others]

    def read(self, ready: Container[int]) -> list[str]:
        """Return the complete lines received; ready: descriptors with data to read. Raises StreamEnded."""
        lines = super().read(ready)
        if not super().sources:
            raise StreamEnded
        self._take()
        return lines


def send(**message: Any) -> None:
    """Report to the process that has started this one."""
    os.write(sys.stdout.fileno(), (json.dumps(message) + "\n").encode())  # unbuffered, in one piece


def note(line: str) -> None:
    """Report a line for a person."""
    send(note=line)


def obey(schedule: Schedule, order: str) -> None:
    """Carry out a fault's order, and report when it took effect, or why it was refused."""
    try:
        send(done=schedule.obey(order, now := monotonic()), time_s=now)
    except InputError as error:
        send(refused=order, reason=str(error))


def run(part: Callable[[Job, list[int]], None]) -> None:
    """Run a process: `part`, with its job, and the descriptors that are its arguments.

    It ends with the process that has started it, or with one that it exchanges records with. Errors are reported.
    """
    try:
        part(Job.of_line(_first_line()), [int(argument) for argument in sys.argv[1:]])
    except (StreamEnded, BrokenPipeError, KeyboardInterrupt):
        return
    except FlexneedleError as error:
        send(failed=one_line(error), input=isinstance(error, InputError))
        sys.exit(1)


def _first_line() -> str:
    """The first line on stdin, and nothing after it, which are orders. Raises StreamEnded."""
    received = bytearray()
    while not received.endswith(b"\n"):
        if not (byte := os.read(sys.stdin.fileno(), 1)):
            raise StreamEnded
        received += byte
    return received.decode()
