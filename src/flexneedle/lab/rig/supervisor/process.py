"""Process of the supervisor: `python -m flexneedle.lab.rig.supervisor.process CHANNEL SIGNALS SIGNALS`.

The client starts it, with the descriptors of a channel for requests and of both ends of a socket for signals. It
ticks on the monotonic clock; a tick that is later than the next one is counted and left out. As a separate process it
is not delayed by a planner that keeps Python busy, and either process may be killed: without the client the
supervisor stops the motors and ends, and without the supervisor motors stop at the end of their queue.
"""

import gc
import socket
import sys
from contextlib import ExitStack, closing
from multiprocessing.connection import wait
from time import monotonic
from typing import Any

from flexneedle.errors import FlexneedleError, describe_error, one_line
from flexneedle.lab.process import MessageChannel, open_channel
from flexneedle.lab.rig.devices.clock import Suspension, WallClock
from flexneedle.lab.rig.devices.lock import hold_motors
from flexneedle.lab.rig.devices.opening import address_of, open_motors, open_tracker
from flexneedle.lab.rig.devices.priority import set_realtime_priority
from flexneedle.lab.rig.supervisor import protocol
from flexneedle.lab.rig.supervisor.core import Supervisor
from flexneedle.lab.rig.supervisor.dry import DryRunMotors
from flexneedle.lab.rig.supervisor.signals import name_signals, open_signal_socket
from flexneedle.types import Frame

_MOST_WAITING = 400  # messages that a client has not taken: 10 s of reports
_REST_S = 2.0  # longest wait for motors to rest before the end
_FLUSH_S = 1.0  # longest wait for a client that does not read, at the end
_LONGEST_SUSPENSION_S = 0.5  # after which motions continue
_CLOSED = "closed"


class NoTracker:
    """The port `Tracker` without a tracker, for motions of the operator."""

    status = "not opened"

    def read(self) -> tuple[Frame, ...]:
        """Return no frames."""
        return ()

    def close(self) -> None:
        """Do nothing."""


def main(requests: int, received: int, sent: int) -> None:
    """Serve the client until it closes or ends. received, sent: the ends of the socket of signals."""
    channel, signals = open_channel(requests, most_waiting=_MOST_WAITING), open_signal_socket(received, sent)
    task = channel.receive_first()
    why = "the supervisor failed"
    try:
        why = _serve(channel, task, signals)
    except FlexneedleError as error:
        why = one_line(error)
    except Exception as error:
        why = f"the supervisor failed: {describe_error(error)}"
        raise
    finally:
        channel.send(protocol.SupervisorEnded(why))
        channel.flush(_FLUSH_S)


def _serve(channel: MessageChannel, task: protocol.SupervisorTask, signals: socket.socket) -> str:
    """Open the devices, tick until the end, and return its reason."""
    clock = WallClock(start=task.started)
    with closing(open_motors(task.rig)) as connected, ExitStack() as stack:
        if not task.dry:  # before a command is sent or the tracker is opened, which the other program uses
            stack.enter_context(hold_motors(address_of(task.rig.driver, connected), task.client))
        tracked = open_tracker(task.rig, clock) if task.tracked else NoTracker()
        tracker = stack.enter_context(closing(tracked))
        motors = DryRunMotors(connected, clock) if task.dry else connected
        answers: list[Any] = []
        core = Supervisor(task, motors, tracker, clock, answers.append)
        set_realtime_priority()
        gc.collect()
        gc.freeze()
        gc.disable()  # nothing here makes cycles; a collection would delay a tick
        try:
            return _tick(channel, core, answers, signals, 1.0 / task.rig.loop.rate_hz)
        finally:
            motors.stop()


def _tick(
    channel: MessageChannel,
    core: Supervisor,
    answers: list[Any],
    signals: socket.socket,
    period: float,
) -> str:
    """Tick until the client ends; return the reason.

    answers: messages of the core. The report of a tick is sent before them, so that a client that receives the end of
    a motion has the positions after it.
    """
    due, missed, ending, why = monotonic(), 0, None, ""
    suspension = Suspension()
    while ending is None or (monotonic() < ending and not core.at_rest):
        sources: list[Any] = [signals] if ending is not None else [signals, channel]
        ready: list[Any] = wait(sources, max(0.0, due - monotonic()))
        # Before any request is acted on.
        if (seconds := suspension.since()) > _LONGEST_SUSPENSION_S:
            core.stop(f"the computer was suspended for {seconds:.1f} s")
        if signals in ready and (names := name_signals(signals.recv(64))):
            core.stop(f"signal {names}")
        if channel in ready and (closed := _act_on_requests(channel, core)):
            core.stop(closed)
            ending, why = monotonic() + _REST_S, "" if closed == _CLOSED else closed
        late = monotonic() - due
        if late >= 0.0:
            begun, skipped = monotonic(), int(late / period)
            missed += skipped
            due += period * (1 + skipped)
            core.tick()
            channel.send(core.report(late, monotonic() - begun, missed), keep=False)
        while answers:
            channel.send(answers.pop(0))
    return why


def _act_on_requests(channel: MessageChannel, core: Supervisor) -> str:
    """Act on the requests of the client; return the reason to end, "" to continue."""
    for request in channel.receive():
        if isinstance(request, protocol.CloseCommand):
            return _CLOSED
        core.request(request)
    return "the controller has ended" if channel.ended else ""


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
