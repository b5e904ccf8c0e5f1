"""The child's side of the processes of an emulated rig: its job, orders, reports and end."""

import sys
from collections.abc import Callable, Container, Sequence
from time import monotonic
from typing import Any

from flexneedle.errors import FlexneedleError, InputError, one_line
from flexneedle.lab.emulators.emulated_rig.job import EmulationJob
from flexneedle.lab.emulators.emulated_rig.stream import ChannelEnded
from flexneedle.lab.emulators.faults import FaultSchedule
from flexneedle.lab.process import MessageChannel, open_channel

_FLUSH_S = 1.0


class Parent:
    """Process that has started this one: it sends orders and receives reports.

    others: further channels to wait for; take: function that reads them.
    """

    def __init__(self, channel: MessageChannel) -> None:
        self._channel = channel
        self.others: Sequence[MessageChannel] = ()
        self.take: Callable[[], None] = lambda: None

    @property
    def sources(self) -> list[int]:
        """Descriptors to wait for."""
        return [one.fileno() for one in (self._channel, *self.others)]

    def read(self, ready: Container[int]) -> list[str]:
        """Return the orders received; ready: descriptors with data to read. Raises ChannelEnded."""
        orders = self._channel.receive() if self._channel.fileno() in ready else []
        if self._channel.ended:
            raise ChannelEnded
        self.take()
        return orders

    def report(self, **message: Any) -> None:
        """Report values by name."""
        if not self._channel.send(message):
            raise ChannelEnded

    def note(self, line: str) -> None:
        """Report a line for a person."""
        self.report(note=line)

    def obey(self, schedule: FaultSchedule, order: str) -> None:
        """Carry out a fault's order, and report when it took effect, or why it was refused."""
        try:
            self.report(done=schedule.obey(order, now := monotonic()), time_s=now)
        except InputError as error:
            self.report(refused=order, reason=str(error))


def run(part: Callable[[EmulationJob, Parent, list[MessageChannel]], None]) -> None:
    """Run a part of the rig: a function of its job, its parent, and the channels to other parts.

    The process ends with its parent, or with a part that it exchanges records with. Errors are reported.
    """
    channel, *others = (open_channel(int(descriptor)) for descriptor in sys.argv[1:])
    parent = Parent(channel)
    try:
        part(channel.receive_first(), parent, others)
    except (ChannelEnded, EOFError, KeyboardInterrupt):
        channel.flush(_FLUSH_S)
    except FlexneedleError as error:
        channel.send({"failed": one_line(error), "input": isinstance(error, InputError)})
        channel.flush(_FLUSH_S)
        sys.exit(1)
