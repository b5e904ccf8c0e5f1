"""Who is connected, and who of them steers."""

from flexneedle.lab.page.messages import People as PeopleNews
from flexneedle.lab.page.server.refusal import Refusal


class People:
    """Clients by number; at most one of them steers."""

    def __init__(self) -> None:
        self.clients = set[int]()
        self.steering: int | None = None
        self._last = 0

    def join(self) -> int:
        """The number of a new client."""
        self._last += 1
        self.clients.add(self._last)
        return self._last

    def leave(self, client: int) -> None:
        """A client is gone, and its steering with it."""
        self.clients.discard(client)
        if self.steering == client:
            self.steering = None

    def steer(self, client: int, take: bool) -> None:
        """Take or release the steering. Raises Refusal if another client steers."""
        if self.steering not in (None, client):
            raise Refusal(f"person {self.steering} is in control: it must release it first")
        self.steering = client if take else None

    def require(self, client: int) -> None:
        """Raise Refusal unless a client steers."""
        if self.steering is None:
            raise Refusal("nobody is in control: take control first")
        if self.steering != client:
            raise Refusal(f"person {self.steering} is in control: ask for it first")

    def news(self) -> PeopleNews:
        """Who is here."""
        return PeopleNews(clients=len(self.clients), steering=self.steering)
