"""A request that is not carried out."""

from collections.abc import Mapping


class Refusal(Exception):
    """Why a request is refused, in one line; problems: by key of the scenario."""

    def __init__(self, reason: str, problems: Mapping[str, str] | None = None) -> None:
        super().__init__(reason)
        self.reason, self.problems = reason, dict(problems or {})
