"""The OpenIGTLink node of an insertion: a separate process, so that no peer takes time of the rig or the controller.

    python -m flexneedle.lab.igtl.node CHANNEL

CHANNEL is the descriptor of a channel to `flexneedle.lab.link.client.LinkClient`. The first record on it is the
`NodeSetup`. The node sends the messages of the later records to its peers, and sends back the records of received
messages. It ends when the other end is closed.
"""

import asyncio
import signal
import sys
from collections import deque
from collections.abc import Iterable
from time import monotonic

from flexneedle.errors import InputError, make_printable
from flexneedle.lab.igtl.composer import IgtlComposer
from flexneedle.lab.igtl.endpoint import describe_failure, make_endpoint
from flexneedle.lab.igtl.messages import Message
from flexneedle.lab.igtl.records import InsertionBegin, NodeSetup, PeerGeometry, TargetWait
from flexneedle.lab.igtl.requests import PathRequest, StopRequest, read_request
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.link.records import LinkNote, LinkRefusal, LinkStop, NodeHeartbeat, NodeLoss
from flexneedle.lab.process import MessageChannel, open_channel

BEAT_S = 0.1
_STATUS_BEATS = 5  # beats from one STATUS to the next, while nothing is published
_MOST_NOTED = 64  # names of unused messages that are reported


class IgtlNode:
    """Reads requests, and sends messages."""

    def __init__(self, setup: NodeSetup, channel: MessageChannel) -> None:
        self._settings, self._channel = setup.settings, channel
        self._composer = IgtlComposer(setup.epoch, setup.registration)
        self._awaits_target = setup.awaits
        self._registration: ImageRegistration | None = None  # the one received last
        self._refused, self._refused_at = 0, -BEAT_S
        self._noted: set[tuple[str, str]] = set()
        address = setup.settings.address
        self.endpoint = make_endpoint(
            self.receive, self._log, address.host, address.port, connects=address.connects
        )
        self._records, self._arrived = deque[object](), asyncio.Event()

    async def run(self) -> None:
        """Send and receive until the other end of the channel is closed. Raises OSError if the port is taken."""
        async with self.endpoint:
            if not self._settings.address.connects:
                self._log(f"listens on {self.endpoint.host}:{self.endpoint.port}")
            loop = asyncio.get_running_loop()
            loop.add_reader(self._channel.fileno(), self._read_records)
            beats = asyncio.create_task(self._beat())
            while not self._channel.ended or self._records:
                await self._arrived.wait()
                self._arrived.clear()
                while self._records:
                    self.take(self._records.popleft())
                    await asyncio.sleep(0)  # peers have their turn
            beats.cancel()

    async def _beat(self) -> None:
        number = 0
        while True:
            self._channel.send(NodeHeartbeat(monotonic()), keep=False)
            if number % _STATUS_BEATS == 0:
                self._send([self._composer.make_status(monotonic())])
            number += 1
            await asyncio.sleep(BEAT_S)

    def _read_records(self) -> None:
        self._records.extend(self._channel.receive())
        self._arrived.set()
        if self._channel.ended:
            asyncio.get_running_loop().remove_reader(self._channel.fileno())

    # From the insertion

    def take(self, record: object) -> None:
        """Publish a record."""
        match record:
            case InsertionBegin(registration):
                self._awaits_target = False
                self._noted.clear()
                self._composer.begin(registration)
            case TargetWait():
                self._awaits_target = True
        self._send(self._composer.compose(record, monotonic()))

    def _send(self, messages: Iterable[Message]) -> None:
        """Send messages; one with values that do not fit, such as NaN, is reported instead."""
        for message in messages:
            try:
                self.endpoint.send(message)
            except InputError as error:
                self._note_unused(message, "this program", f"not sent: {error}")

    # From peers

    def receive(self, message: Message, peer: str) -> None:
        """Take a message of a peer."""
        try:
            request = read_request(message, self._settings.registration)
            match request:
                case StopRequest():
                    self._channel.send(LinkStop(monotonic(), peer))
                case ImageRegistration():
                    self._register(request, peer)
                case PathRequest():
                    self._aim(request, message, peer)
                case None:
                    self._note_unused(message, peer, "not used")
        except InputError as error:
            self._refuse(peer, f"{_name(message)}: {error}")

    def _register(self, registration: ImageRegistration, peer: str) -> None:
        if registration != self._registration:  # a peer may repeat it
            self._registration = registration
            self._channel.send(PeerGeometry(peer, registration))

    def _aim(self, path: PathRequest, message: Message, peer: str) -> None:
        if not self._awaits_target:
            self._note_unused(message, peer, "ignored, no target is awaited")
            return
        if path == PathRequest(None, None):
            raise InputError("no point is named Target or Entry")
        self._channel.send(PeerGeometry(peer, self._registration, path.target, path.entry))

    def _refuse(self, peer: str, reason: str) -> None:
        """Report a refusal, unless it follows another one soon, as in a flood of messages."""
        self._refused += 1
        now = monotonic()
        if now - self._refused_at >= BEAT_S:
            self._refused_at = now
            self._channel.send(LinkRefusal(now, peer, make_printable(reason), self._refused), keep=False)

    def _note_unused(self, message: Message, peer: str, why: str) -> None:
        """Report a message that is not used, once for each name and reason."""
        key = _name(message), why
        if key not in self._noted and len(self._noted) < _MOST_NOTED:
            self._noted.add(key)
            self._note(f"{key[0]} of {peer}: {why}")

    def _note(self, text: str) -> None:
        self._channel.send(LinkNote(monotonic(), text), keep=False)

    def _log(self, line: str) -> None:
        self._note(f"OpenIGTLink: {line}")


def _name(message: Message) -> str:
    return make_printable(f"{message.type} {message.name!r}")


async def serve(setup: NodeSetup, channel: MessageChannel) -> int:
    """Run a node to its end; return the exit status."""
    node = IgtlNode(setup, channel)
    try:
        await node.run()
    except OSError as error:
        channel.send(NodeLoss(monotonic(), describe_failure(node.endpoint.host, node.endpoint.port, error)))
        channel.flush(BEAT_S)
        return 1
    return 0


def main(descriptor: int) -> int:
    """Run a node on the channel of the command line."""
    channel = open_channel(descriptor)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the rig, which then closes the channel
    try:
        setup = channel.receive_first()
    except EOFError:
        return 0
    return asyncio.run(serve(setup, channel))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
