"""Commands that a controller carries out, and queries that it answers by numbers or a line of text, or refuses."""

from collections.abc import Sequence

from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.link import Link
from flexneedle.lab.rig.devices.galil.replies import GarbledError, format_commands, parse_numbers, parse_text

_REASON = "TC1"


class Dialogue:
    """Commands and queries on a link.

    Each method raises DriverError: with the controller's reason for a command that it refuses; or with the problem of
    the link, which is then closed.
    """

    def __init__(self, link: Link) -> None:
        self._link = link

    def do(self, commands: Sequence[str], deadline: float) -> None:
        """Have commands carried out."""
        if any(self._data(commands, deadline)):
            raise self._link.failed(f"data in the reply to {format_commands(commands)}")

    def numbers(
        self, queries: Sequence[str], counts: Sequence[int], deadline: float
    ) -> list[tuple[float, ...]]:
        """Return the answers to queries: `counts` numbers each."""
        found = self._data(queries, deadline)
        try:
            return [parse_numbers(data, count) for data, count in zip(found, counts, strict=True)]
        except GarbledError as error:
            raise self._link.failed(f"{error} (to {format_commands(queries)})") from None

    def text(self, query: str, deadline: float) -> str:
        """Return the line of text that answers a query."""
        (data,) = self._data([query], deadline)
        try:
            return parse_text(data)
        except GarbledError as error:
            raise self._link.failed(str(error)) from None

    def _data(self, commands: Sequence[str], deadline: float) -> tuple[str, ...]:
        replies = self._link.ask(commands, deadline)
        refused = [command for command, reply in zip(commands, replies, strict=True) if not reply.accepted]
        if refused:
            raise DriverError(
                f"{self._link.name}: {format_commands(refused)} refused: {self._why(refused, deadline)}"
            )
        return tuple(reply.data for reply in replies)

    def _why(self, refused: Sequence[str], deadline: float) -> str:
        """Return the controller's reason, its code and text, for the last of the commands."""
        if _REASON in refused:
            return "no reason given"
        try:
            return self.text(_REASON, deadline)
        except DriverError as error:
            return f"unknown reason: {error}"
