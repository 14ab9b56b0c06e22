"""What the server in front of a fleet must know of its cluster: whether Ray is there, and whether a replica runs.

Without it, a server whose Ray has ended would accept robots, say that it is well, and let each request wait for
minutes. It knows nothing of Ray itself: fleet.py hands in the checks.
"""

import logging
import socket
import threading
from collections.abc import Callable

logger = logging.getLogger(__name__)

RAY_SECONDS = 1.0  # between two checks of Ray's cluster
LOST_AFTER = 2  # such checks in a row that found neither Ray nor a replica
CONNECT_SECONDS = 2.0
REPLICAS_SECONDS = 3.0  # between two calls of Ray Serve, of which each costs the server 10 ms of CPU
JOIN_SECONDS = 1.0


class Watch:
    """Checks on two threads of its own, as Ray Serve may not answer a call when Ray ends.

    address          of Ray's control service, host:port
    replica_answers  whether a replica can be reached, in a few seconds. While Ray's control service alone is away (it
                     may come back), replicas go on
    why_unwell       why no replica runs; None if one does, or if it isn't known. It may raise any exception
    """

    def __init__(self, address: str, replica_answers: Callable[[], bool], why_unwell: Callable[[], str | None]) -> None:
        self._address, self._replica_answers, self._why_unwell = address, replica_answers, why_unwell
        self._enough = threading.Event()
        self._threads: list[threading.Thread] = []
        self.unwell: str | None = None

    def start(self, on_lost: Callable[[str], object]) -> None:
        """`on_lost(reason)` is called once, on a thread, if Ray has ended."""
        for name, work in (("ray", lambda: self._watch_ray(on_lost)), ("replicas", self._watch_replicas)):
            self._threads.append(threading.Thread(target=work, name=f"turbopi-watch-{name}", daemon=True))
            self._threads[-1].start()

    def stop(self) -> None:
        self._enough.set()
        for thread in self._threads:
            thread.join(JOIN_SECONDS)

    def _watch_ray(self, on_lost: Callable[[str], object]) -> None:
        in_vain = 0
        while not self._enough.wait(RAY_SECONDS):
            in_vain = 0 if answers(self._address) or self._replica_answers() else in_vain + 1
            if in_vain == LOST_AFTER and not self._enough.is_set():
                on_lost(
                    f"Ray's cluster at {self._address} has ended, and all replicas with it. Start this server again"
                )
                return

    def _watch_replicas(self) -> None:
        while not self._enough.wait(REPLICAS_SECONDS):
            try:
                self.unwell = self._why_unwell()
            except Exception as error:  # Ray raises many kinds while its controller is away
                logger.debug("Ray Serve doesn't say how many replicas run: %s", error)
                self.unwell = None


def answers(address: str) -> bool:
    """Whether a process listens at host:port."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except OSError:
        return False
    return True
