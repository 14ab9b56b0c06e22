"""To which replica a fleet's clients come back."""

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
