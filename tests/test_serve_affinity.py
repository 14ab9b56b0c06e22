"""To which replica a fleet's clients come back."""

import asyncio
import importlib
import sys
import threading
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from turbopi.serve.fleet.replica import Line
from turbopi.serve.fleet.session_affinity import ACTIVE_SECONDS, MAX_CLIENTS, SOON_SECONDS, SessionAffinity


def affinity(clients: int, of: str = "left", at: float = 0.0) -> SessionAffinity:
    """`clients` of them, numbered from 0, that this replica has answered."""
    made = SessionAffinity()
    for client in range(clients):
        made.answered(client, of, at)
    return made


def test_who_asks_again_at_once_comes_back_to_the_replica_that_answered() -> None:
    made, counts = affinity(4), {"left": 1, "right": 0}
    assert made.replica_for(0, counts, 0.01) == "left"
    assert made.replica_for(0, counts, SOON_SECONDS + 0.01) is None, (
        "it has no company that comes back together with it"
    )
    assert made.replica_for("a new one", counts, 0.01) is None
    made.answered(0, "right", 0.02)
    assert made.replica_for(0, counts, 0.03) == "right"


def test_no_replica_has_more_than_its_share_of_the_clients() -> None:
    made = affinity(8)
    assert [made.replica_for(0, {"left": there, "right": 0}, 0.01) for there in (3, 4)] == ["left", None]
    assert made.replica_for(0, {"left": 4}, 0.01) == "left", "all are its own"
    made = affinity(9)
    assert made.replica_for(0, {"left": 4, "right": 0}, 0.01) == "left", "nine are five and four"


def test_clients_that_left_have_no_share() -> None:
    made = affinity(8)
    later = ACTIVE_SECONDS + 0.01
    for client in range(2):
        made.answered(client, "left", later)
    assert [made.replica_for(0, {"left": there, "right": 0}, later) for there in (0, 1)] == ["left", None]


def test_a_replica_that_is_gone_is_nobodys() -> None:
    assert affinity(4).replica_for(0, {"right": 0}, 0.01) is None


def test_clients_are_forgotten() -> None:
    made = affinity(3 * MAX_CLIENTS)
    assert (
        made.replica_for(0, {"left": 0}, 0.0) is None
        and made.replica_for(3 * MAX_CLIENTS - 1, {"left": 0}, 0.0) == "left"
    )


def test_the_router_notes_answers_on_its_own_loop_although_ray_tells_of_them_on_another_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The router changes its homes while it looks through them otherwise."""
    ray, serve, routers = (ModuleType(name) for name in ("ray", "ray.serve", "ray.serve.request_router"))
    routers.RequestRouter = object  # type: ignore[attr-defined]
    for module in (ray, serve, routers):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.delitem(sys.modules, "turbopi.serve.fleet.ray_router", raising=False)
    router = importlib.import_module("turbopi.serve.fleet.ray_router").FewestRequests()
    monkeypatch.delitem(sys.modules, "turbopi.serve.fleet.ray_router")
    router.replica_queue_len_cache = {"left": 1, "right": 0}
    replicas = [SimpleNamespace(replica_id=name) for name in ("left", "right")]
    request = SimpleNamespace(args=({}, Line(source="a robot")))
    threads = []

    def answered(*given: Any) -> None:
        threads.append(threading.get_ident())
        SessionAffinity.answered(router._affinity, *given)

    monkeypatch.setattr(router._affinity, "answered", answered)

    def end(callback: Callable[[Any], None]) -> None:
        thread = threading.Thread(target=callback, args=(None,))
        thread.start()
        thread.join()

    async def main() -> list[list[list[str]]]:
        chosen = [await router.choose_replicas(replicas, request)]
        router.on_request_routed(request, "left", SimpleNamespace(add_done_callback=end))
        router.on_request_routed(SimpleNamespace(args=("another method's",)), "right", None)
        await asyncio.sleep(0)
        monkeypatch.setitem(router.replica_queue_len_cache, "left", 0)
        chosen.append(await router.choose_replicas(replicas, request))
        return [[sorted(one.replica_id for one in group) for group in groups] for groups in chosen]

    assert asyncio.run(main()) == [[[], ["left", "right"]], [["left"], ["left", "right"]]]
    assert threads == [threading.get_ident()]
