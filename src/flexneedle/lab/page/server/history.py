"""History of the session: steps that are undone and redone."""

from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.page_session import PageSession

_MOST = 200
"""Steps that are kept."""


class SessionHistory:
    """Sessions before and after the present one."""

    def __init__(self) -> None:
        self._before, self._after = list[PageSession](), list[PageSession]()
        self._open: frozenset[str] | None = None
        """Keys of the last step while further edits of them belong to it, as during a drag."""

    @property
    def undoes(self) -> bool:
        """Whether a step can be undone."""
        return bool(self._before)

    @property
    def redoes(self) -> bool:
        """Whether a step can be redone."""
        return bool(self._after)

    def add(self, before: PageSession, after: PageSession, keys: frozenset[str] | None = None) -> None:
        """Add a step, unless nothing has changed. keys: of an edit, which may continue the last step."""
        if after.has_content_of(before):
            return
        if keys is None or keys != self._open:
            self._before = [*self._before, before][-_MOST:]
        self._open = keys
        self._after = []

    def close(self) -> None:
        """End the last step: a further edit of the same keys is another one."""
        self._open = None

    def undo(self, present: PageSession) -> PageSession:
        """Return the session before the last step. Raises Refusal without one."""
        return self._move(self._before, self._after, present, "undo")

    def redo(self, present: PageSession) -> PageSession:
        """Return the session after the step that was undone last. Raises Refusal without one."""
        return self._move(self._after, self._before, present, "redo")

    def _move(
        self, source: list[PageSession], goal: list[PageSession], present: PageSession, what: str
    ) -> PageSession:
        if not source:
            raise Refusal(f"there is nothing to {what}")
        self.close()
        goal.append(present)
        return present.resume(source.pop())
