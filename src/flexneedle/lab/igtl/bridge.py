"""Connection of insertions to OpenIGTLink: sends their geometry and states, and receives stops and targets."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from flexneedle.errors import FlexneedleError, one_line
from flexneedle.lab.igtl.records import InsertionBegin, InsertionResult, NodeSetup, TargetWait
from flexneedle.lab.igtl.settings import IgtlSettings
from flexneedle.lab.images.frames import ImageRegistration
from flexneedle.lab.link.bridge import LinkBridge
from flexneedle.lab.link.client import LinkClient
from flexneedle.lab.link.records import LinkTarget
from flexneedle.loop.events import Ended
from flexneedle.planning.events import Event, Iterated

_PLANNING, _ENDED = "planning", "ended"


def _ignore(_text: str) -> None:
    """Do nothing."""


class IgtlBridge(LinkBridge):
    """The connection of an insertion to OpenIGTLink, as a `LinkBridge`; with `insertion`, of further ones.

    Args:
        settings: Address and names.
        show: Prints a line for the user; called in the thread of the insertion only.
        registration: Map of the image to the needle's frame, None if it is not known (yet): then geometry is sent in
            the needle's frame until a peer sends one.

    Raises RunError if the port is taken or the node does not start.
    """

    protocol = stop_source = "OpenIGTLink"

    def __init__(
        self,
        settings: IgtlSettings,
        show: Callable[[str], None] = _ignore,
        registration: ImageRegistration | None = None,
    ) -> None:
        self.settings = settings
        self._on_stop: Callable[[str], None] = _ignore
        self._over = False

        def open_node(epoch: float) -> LinkClient:
            return LinkClient(f"{__package__}.node", NodeSetup(settings, epoch, registration), self.protocol)

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
        show: Callable[[str], None] = _ignore,
        registration: ImageRegistration | None = None,
        on_stop: Callable[[str], None] = _ignore,
    ) -> Iterator[None]:
        """Publish another insertion than the first: earlier stops and targets do not count.

        Args:
            show: As for the class.
            registration: As for the class; None: the one that was received last, if any, remains.
            on_stop: Called with the reason of a stop, in another thread.
        """
        self._begin(self._first_record, show)
        self._on_stop, self._over = on_stop, False
        self._node.publish(InsertionBegin(registration))
        self._change_state("idle")
        try:
            yield
        except FlexneedleError as error:
            self._finish(one_line(error))
            raise
        finally:
            self._announce_end()

    def end(self, text: str) -> None:
        """End the insertion with its result in one line; later stops have no effect."""
        self._over, self._supervisor = True, None
        self._node.publish(InsertionResult(self._now(), text))
        self._change_state(_ENDED, text)

    def await_target(self) -> LinkTarget:
        """Wait for a target, and an entry before it or with it (mm, needle's frame).

        Raises StoppedError after a stop, RunError without the node.
        """
        self._node.publish(TargetWait())
        return self._await_target("a target of a peer")

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

    def _stop(self, who: str) -> None:
        if self._over:
            self._note_others(f"stop: {who}: ignored, there is no insertion")
            return
        super()._stop(who)
        self._on_stop(who)
