"""A fleet's name is of one server in front, as long as that lives.

A second one of the same name would replace the first one's replicas, and another policy would move its robots. After a
crash the name is free again, though the replicas may be there still: the next server takes them over.
"""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

from turbopi.serve.fleet.fleet import POLL_SECONDS, REACH_SECONDS, address, import_ray
from turbopi.serve.fleet.watch import answers
from turbopi.support.errors import ConfigError

NAMESPACE = "turbopi_fronts"  # Ray's, for the servers in front
FREED_SECONDS = 5.0  # that Ray may take to see that a server in front has ended: it took 0.02


class _Front:
    """An actor that reserves a fleet's name for the server in front: Ray ends it with the process that made it."""

    def __init__(self, owner: str) -> None:
        self._owner = owner

    def owner(self) -> str:
        return self._owner


@contextmanager
def claimed(name: str) -> Iterator[None]:
    """The fleet's name for this process alone, for this block. Raises ConfigError if a server that lives has it."""
    ray, _ = import_ray()
    actor = ray.remote(num_cpus=0, max_restarts=-1)(_Front).options(name=name, namespace=NAMESPACE)
    deadline = time.monotonic() + FREED_SECONDS
    while True:
        try:
            front = actor.remote(f"process {os.getpid()} on {socket.gethostname()}")
            break
        except ValueError as error:  # the name is taken
            if time.monotonic() > deadline:
                raise ConfigError(
                    f"a fleet {name!r} runs already{_owner_of(name)}: --fleet NAME starts another one, --update "
                    f"--fleet {name} replaces its weights"
                ) from error
            time.sleep(POLL_SECONDS)
    try:
        yield
    finally:
        if answers(address()):
            ray.kill(front)


def _owner_of(name: str) -> str:
    """The server that has the name, for an error's text; empty if it can't be found out."""
    ray, _ = import_ray()
    try:
        owner = ray.get(ray.get_actor(name, namespace=NAMESPACE).owner.remote(), timeout=REACH_SECONDS)
    except (ValueError, ray.exceptions.RayError):  # it has just ended, or is being started
        return ""
    return f" (its server is {owner})"
