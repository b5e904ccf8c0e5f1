"""Connection of insertions to OpenIGTLink: sends their geometry and states, and receives stops and targets."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from flexneedle.errors import FlexneedleError, InputError, one_line
from flexneedle.lab.igtl.placement import Placer
from flexneedle.lab.igtl.records import InsertionBegin, InsertionResult, NodeSetup, PeerGeometry, TargetWait
from flexneedle.lab.igtl.settings import IgtlSettings
from flexneedle.lab.images.frames import registration_of
from flexneedle.lab.link.bridge import LinkBridge
from flexneedle.lab.link.client import LinkClient
from flexneedle.lab.link.records import LinkTarget
from flexneedle.loop.events import Ended
from flexneedle.planning.events import Event, Iterated
from flexneedle.scenario.model import Scenario

_PLANNING, _ENDED = "planning", "ended"


def _ignore(_text: str) -> None:
    """Do nothing."""


class IgtlBridge(LinkBridge):
    """The connection of an insertion to OpenIGTLink, as a `LinkBridge`; with `insertion`, of further ones.

    Args:
        settings: Address and names.
        show: Prints a line for the user; called in the thread of the insertion only.
        scenario: Scenario of the insertion. Geometry is sent in the frame of its image, or without one in the needle's.
        awaits: Whether `await_target` follows.
        forward: Called in another thread with what is received between insertions (default: it is refused).

    Raises RunError if the port is taken or the node does not start.
    """

    protocol = stop_source = "OpenIGTLink"

    def __init__(
        self,
        settings: IgtlSettings,
        show: Callable[[str], None] = _ignore,
        scenario: Scenario | None = None,
        *,
        awaits: bool = False,
        forward: Callable[[PeerGeometry], object] | None = None,
    ) -> None:
        self.settings = settings
        self._on_stop: Callable[[str], None] = _ignore
        self._placer = Placer(settings.entry_radius)
        self._scenario, self._awaits, self._forward = scenario, awaits, forward
        self._placed: Scenario  # with the target that was awaited
        self._over = forward is not None
        registration = None if scenario is None else registration_of(scenario)

        def open_node(epoch: float) -> LinkClient:
            setup = NodeSetup(settings, epoch, registration, awaits or self._over)
            return LinkClient(f"{__package__}.node", setup, self.protocol)

        super().__init__(open_node, self._first_record, show)

    @property
    def _first_record(self) -> dict[str, str]:
        return {"address": str(self.settings.address)}

    def __exit__(self, *exception: object) -> None:
        for error in exception:
            if isinstance(error, FlexneedleError):
                self._finish(one_line(error))
        self.close()

    @contextmanager
    def insertion(
        self,
        scenario: Scenario,
        show: Callable[[str], None] = _ignore,
        on_stop: Callable[[str], None] = _ignore,
    ) -> Iterator[None]:
        """Publish another insertion than the first: earlier stops and targets do not count.

        Args:
            scenario: As for the class.
            show: As for the class.
            on_stop: Called with the reason of a stop, in another thread.
        """
        self._begin(self._first_record, show)
        self._on_stop, self._over, self._scenario = on_stop, False, scenario
        self._node.publish(InsertionBegin(registration_of(scenario)))
        self._change_state("idle")
        try:
            yield
        except FlexneedleError as error:
            self._finish(one_line(error))
            raise
        finally:
            self._announce_end()
            if self._forward is not None:
                self._node.publish(TargetWait())

    def end(self, text: str) -> None:
        """End the insertion with its result in one line; later stops have no effect."""
        self._over, self._supervisor = True, None
        self._node.publish(InsertionResult(self._now(), text))
        self._change_state(_ENDED, text)

    def await_target(self) -> Scenario:
        """Wait for a target, and an entry before it or with it; return the scenario with them and the registration.

        Raises StoppedError after a stop, RunError without the node.
        """
        self._await_target("a target of a peer")
        self._node.publish(InsertionBegin(registration_of(self._placed)))
        return self._placed

    def __call__(self, event: Event) -> None:
        """Publish an event. After a stop, raises StoppedError at each event in the insertion's thread."""
        match event:
            case Iterated() if not self._stopped:
                self._change_state(_PLANNING)
            case Ended(insertion):
                self.end(insertion.summary)
        super().__call__(event)

    def _announce_end(self) -> None:
        self._finish(f"stopped: {self._stopped}" if self._stopped else "ended without a result")

    def _finish(self, text: str) -> None:
        if not self._over:
            self.end(text)

    def _take(self, record: Any) -> None:
        if not isinstance(record, PeerGeometry):
            super()._take(record)
        elif self._forward is not None and self._over:
            self._forward(record)
        else:
            self._receive(record)

    def _receive(self, received: PeerGeometry) -> None:
        """Place what was received in the scenario, if it is awaited."""
        scenario = self._scenario
        try:
            if scenario is None or not (self._awaits or self._is_comparable(received)):
                what = "target" if received.has_points else "registration of the image"
                raise InputError(f"{what}: not awaited, the insertion has begun without it")
            placed = self._placer.place(scenario, received)
            scenario = scenario.with_values(placed.values)
        except FlexneedleError as error:
            self._note_others(f"{received.source}: refused: {one_line(error)}")
            return
        for line in placed.lines:
            self._note_others(f"{received.source}: {line}")
        if received.target is not None:
            self._scenario = self._placed = scenario
            self._awaits = False
            self._target = LinkTarget(self._now(), scenario.target.position)

    def _is_comparable(self, received: PeerGeometry) -> bool:
        """Return whether it is a registration that may be the scenario's."""
        has_image = self._scenario is not None and registration_of(self._scenario) is not None
        return has_image and not received.has_points

    def _stop(self, who: str) -> None:
        if self._over:
            self._note_others(f"stop: {who}: ignored, there is no insertion")
            return
        super()._stop(who)
        self._on_stop(who)
