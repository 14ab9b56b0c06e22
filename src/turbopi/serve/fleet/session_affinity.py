"""Session affinity: a client of a short think time goes to the replica that answered it. No clock of its own."""

from collections import OrderedDict
from collections.abc import Hashable, Mapping
from itertools import takewhile
from typing import Any

SOON_SECONDS = 0.05  # from an answer to the next request, of a client with a short think time
ACTIVE_SECONDS = 1.0  # a client that was answered within it is active
MAX_CLIENTS = 1024  # clients that are remembered


class SessionAffinity:
    """Which replica answered each client last.

    Clients of one batch are answered together. With a short think time their next requests arrive together, and form a
    batch again if they go to the same replica; at different replicas each would wait for a batch that never forms.
    """

    def __init__(self) -> None:
        self._answered: OrderedDict[Hashable, tuple[Hashable, float]] = OrderedDict()  # the last one at the end

    def answered(self, client: Hashable, replica: Hashable, now: float) -> None:
        self._answered[client] = replica, now
        self._answered.move_to_end(client)
        if len(self._answered) > MAX_CLIENTS:
            self._answered.popitem(last=False)

    def replica_for(self, client: Hashable, requests: Mapping[Any, int], now: float) -> Hashable | None:
        """The replica that answered the client a moment ago; None after that, or if the replica has its share already.

        requests  how many each replica has now; its share is an equal part of the clients that are active
        """
        replica, when = self._answered.get(client, (None, 0.0))
        if replica not in requests or now - when > SOON_SECONDS:
            return None
        latest = reversed(self._answered.values())
        active = sum(1 for _ in takewhile(lambda one: now - one[1] <= ACTIVE_SECONDS, latest))
        return replica if requests[replica] * len(requests) < active else None
