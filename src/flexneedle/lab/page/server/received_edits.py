"""Edits of the session by what peers of OpenIGTLink send between insertions."""

import sys

from flexneedle.errors import InputError
from flexneedle.lab.igtl.placement import Placer
from flexneedle.lab.igtl.records import PeerGeometry
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.live_insertion import LiveInsertion
from flexneedle.lab.page.server.page_session import PageSession


class ReceivedEdits:
    """Edits, with their lines on stderr. entry_radius: as in `Placer`."""

    def __init__(self, live: LiveInsertion, entry_radius: float) -> None:
        self._live, self._placer = live, Placer(entry_radius)
        self._printed = ""

    def edit(self, session: PageSession, received: PeerGeometry) -> tuple[PageSession, frozenset[str]]:
        """Return the session, edited unless an insertion runs or the edit is refused, and the keys of the edit."""
        try:
            self._live.require_none("nothing is received until its end")
            placed = self._placer.place(session.scenario, received)
            edited = session.edit_scenario(placed.values)
            if received.target is not None:
                self._placer.forget_entry()  # it is in the scenario, where it may be edited
        except (InputError, Refusal) as error:
            self._print(f"{received.source}: refused: {error}")
            return session, frozenset()
        self._print(*(f"{received.source}: {line}" for line in placed.lines))
        return session if edited.has_content_of(session) else edited, frozenset(placed.values)

    def _print(self, *lines: str) -> None:
        """Print lines, unless the last call printed the same: a peer may repeat a message."""
        text = "".join(f"flexneedle: {line}\n" for line in lines)
        if text != self._printed:
            self._printed = text
            print(text, end="", file=sys.stderr, flush=True)
