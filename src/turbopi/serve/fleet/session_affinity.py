"""Which replica a client that asks again at once had better go to. From times alone; no clock of its own."""

from collections import OrderedDict
from collections.abc import Hashable, Mapping
from itertools import takewhile
from typing import Any

SOON_SECONDS = 0.05  # from an answer to the next request, of a client that asks as soon as it is answered
ACTIVE_SECONDS = 1.0  # who was answered within it counts as one
MOST = 1024  # clients that are remembered


class Homes:
    """Who answered each client last.

    Clients that were in one batch are answered together. Those that ask again at once come back together, and are a
    batch again if they come to the same replica; at different ones each would wait for company that went elsewhere.
    """

    def __init__(self) -> None:
        self._answered: OrderedDict[Hashable, tuple[Hashable, float]] = OrderedDict()  # the last one at the end

    def answered(self, client: Hashable, replica: Hashable, now: float) -> None:
        self._answered[client] = replica, now
        self._answered.move_to_end(client)
        if len(self._answered) > MOST:
            self._answered.popitem(last=False)

    def of(self, client: Hashable, requests: Mapping[Any, int], now: float) -> Hashable | None:
        """The replica that answered it a moment ago; None if that is longer ago, or if it has its share already.

        requests  how many each replica has now; its share is an equal part of the clients that are active
        """
        home, when = self._answered.get(client, (None, 0.0))
        if home not in requests or now - when > SOON_SECONDS:
            return None
        latest = reversed(self._answered.values())
        active = sum(1 for _ in takewhile(lambda one: now - one[1] <= ACTIVE_SECONDS, latest))
        return home if requests[home] * len(requests) < active else None
