"""Every attack: what it does, what was expected of it before it ran, its bars, and its share of the whole run."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attack import commands, disks, doors, endings, files, floods, frames
from attack.arena import Arena, Assault, Found, Limits, Siege, Tick, besiege

FRAMES_A_PIECE = 50_000


@dataclass(frozen=True)
class Size:
    """How much of an attack one piece is."""

    count: int = 0
    seconds: float = 10.0
    pieces: int = 1  # of the whole run, each with a seed of its own: 0, 1, …
    few: int = 1  # the count of a small piece

    @property
    def small(self) -> "Size":
        """To try the attack with."""
        return replace(self, count=self.few, seconds=min(self.seconds, 3.0), pieces=1)


@dataclass(frozen=True)
class Attack:
    """One kind of attack. `run(seed, size, folder, tick)` returns what it found and what was seen of the server."""

    name: str
    about: str
    prediction: str
    size: Size
    minutes: float  # that a piece takes, about
    run: Callable[[int, Size, Path, Tick], tuple[Found, dict[str, Any]]]
    timed: bool = True  # has a bar of time, so nothing may run beside it


def _on_a_server(siege: Siege, assault: Assault) -> Any:
    def run(seed: int, size: Size, folder: Path, tick: Tick) -> tuple[Found, dict[str, Any]]:
        return besiege(siege, assault, seed=seed, seconds=size.seconds, count=size.count, folder=folder, tick=tick)

    return run


def _alone(attack: Callable[[int, int, Path, Found, Tick], None]) -> Any:
    def run(seed: int, size: Size, folder: Path, tick: Tick) -> tuple[Found, dict[str, Any]]:
        found = Found()
        attack(seed, size.count, folder, found, tick)
        return found, {}

    return run


def _frames(siege: Siege, shape: tuple[int, int] | None = None) -> Any:
    def run(seed: int, size: Size, folder: Path, tick: Tick) -> tuple[Found, dict[str, Any]]:
        async def assault(arena: Arena) -> None:
            await frames.frames(arena, seed, size.count, shape)

        return besiege(siege, assault, seed=seed, seconds=0, count=size.count, folder=folder, tick=tick)

    return run


def _loud(limits: Limits, **changes: Any) -> Limits:
    return replace(limits, **changes)


_FLOOD = Limits()
_ROBOT = Path(__file__).with_name("robot.json")  # whose observations are those of messages.py
_QUICK = Siege(
    policy="fake:0", limits=Limits(ratio=None, mean_ratio=None, log_kb_s=None), quiet_seconds=1.0, settle_seconds=1.0
)

ATTACKS: dict[str, Attack] = {
    attack.name: attack
    for attack in (
        Attack(
            "frames",
            "a million damaged frames; every answer is checked",
            "none crashes the server; a result comes for a good observation alone, and is its own",
            Size(FRAMES_A_PIECE, pieces=20, few=500),
            3.0,
            _frames(_QUICK),
            timed=False,
        ),
        Attack(
            "frames_model",
            "the same frames at a real model (pi05_tiny): answers are actions, or refusals",
            "as above; the model's own checks refuse what isn't its robot's",
            Size(5_000, pieces=2, few=100),
            3.0,
            _frames(replace(_QUICK, policy="pi05_tiny", options=("--robot", str(_ROBOT))), shape=(10, 7)),
            timed=False,
        ),
        Attack(
            "slow_walk",
            "112 frames a second of 20 kB, each the most work a byte can ask for",
            "the walk is off the event loop: within 1.5 ×",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.slow_walk),
        ),
        Attack(
            "slow_walks",
            "the same frames, eight clients, as fast as they are taken",
            "a budget holds each client back: within 1.5 ×",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.slow_walks),
        ),
        Attack(
            "worst_walks",
            "8 clients' frames of 6 kB of alternating headers, as fast as they are taken",
            "the budget counts what a message costs, not only that it came: within 1.5 ×",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.worst_walks),
        ),
        Attack(
            "reconnecting_walks",
            "the same frames, always over new connections",
            "a new connection brings no new budget worth having: within 1.5 ×",
            Size(),
            0.5,
            _on_a_server(Siege(settle_seconds=20), floods.reconnecting_walks),
        ),
        Attack(
            "one_byte",
            "14,000 frames of one byte a second from one client",
            "within 1.5 ×, and a few lines of log",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.one_byte),
        ),
        Attack(
            "one_byte_many",
            "the same 14,000 from fifty clients",
            "within 1.5 ×, if the event loop's share for strangers is bounded as a whole",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.one_byte_many),
        ),
        Attack(
            "refusals",
            "4,000 messages a second that decode but for their last byte",
            "within 1.5 ×, and a few lines of log",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.refusals),
        ),
        Attack(
            "posts",
            "8 clients' POSTs of many numbers, of images that grow a thousandfold, each with a fault",
            "the credit of a socket goes on from POST to POST: within 1.5 ×",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.posts),
        ),
        Attack(
            "pings_unread",
            "pings as fast as they are taken, pongs never read",
            "the server stops reading who doesn't read: a few MB stay",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.pings_unread),
        ),
        Attack(
            "answers_unread",
            "requests with answers of 1 MB, which are never read",
            "a few answers wait for each such client, no more; the queue is shared, so no bar for latency",
            Size(),
            0.5,
            _on_a_server(Siege(limits=_loud(_FLOOD, ratio=None, mean_ratio=None)), floods.answers_unread),
        ),
        Attack(
            "big_messages",
            "sixty good observations of 60 MB",
            "a small multiple of one message at the peak, nothing afterwards",
            Size(60, few=3),
            1.5,
            _on_a_server(
                Siege(limits=Limits(ratio=None, mean_ratio=None, growth_mb=6 * 60, kept_mb=100)), floods.big_messages
            ),
        ),
        Attack(
            "half_messages",
            "thirty clients that send half of 40 MB and stop",
            "a limit on what all messages that are under way may hold: far below 600 MB",
            Size(seconds=30),
            2.2,
            _on_a_server(Siege(limits=_loud(_FLOOD, growth_mb=400), settle_seconds=40), floods.half_messages),
        ),
        Attack(
            "trickles",
            "a hundred clients that send a message byte by byte",
            "within 1.5 ×",
            Size(seconds=20),
            0.6,
            _on_a_server(Siege(), floods.trickles),
        ),
        Attack(
            "slow_handshakes",
            "three hundred clients whose opening request comes byte by byte",
            "each is closed after the handshake's deadline",
            Size(seconds=20),
            0.6,
            _on_a_server(Siege(), floods.slow_handshakes),
        ),
        Attack(
            "idle",
            "four thousand connections that do nothing, half of them websockets",
            "turned away beyond the limit of clients; the good client notices nothing",
            Size(4000, few=160),
            1.5,
            _on_a_server(Siege(limits=_loud(_FLOOD, growth_mb=400, kept_mb=300)), floods.idle),
        ),
        Attack(
            "no_descriptors",
            "two hundred clients at a server that may have 64 files open",
            "clients beyond are turned away; the log says so at a limited rate; the good client stays",
            Size(),
            0.5,
            _on_a_server(Siege(descriptors=64), floods.no_descriptors),
        ),
        Attack(
            "churn",
            "connections that come and go as fast as they can",
            "within 1.5 ×; no descriptor stays",
            Size(),
            0.5,
            _on_a_server(Siege(), floods.churn),
        ),
        Attack(
            "doors",
            "origins, hosts, keys, methods, broken and huge headers",
            "401, 403 or 400; never 500, never silence",
            Size(3),
            0.5,
            _on_a_server(
                Siege(options=("--api-key", doors.KEY), good_client=False, quiet_seconds=0.5, settle_seconds=0.5),
                doors.doors,
            ),
        ),
        Attack(
            "never_readers",
            "clients that read nothing, then SIGTERM or SIGINT",
            "ended within 20 s, exit code 0",
            Size(6, few=2),
            2.5,
            _alone(endings.never_readers),
        ),
        Attack(
            "killed_clients",
            "clients that die in the middle of a handshake or message",
            "nobody notices",
            Size(200, few=40),
            0.5,
            _on_a_server(Siege(settle_seconds=20), endings.killed_clients),
        ),
        Attack(
            "killed_servers",
            "servers that record are ended by SIGTERM, SIGINT and SIGKILL at random moments",
            "every recording reads back; of SIGTERM and SIGINT with every answer that was sent",
            Size(30, few=3),
            3.0,
            _alone(endings.killed_servers),
        ),
        Attack(
            "early_signals",
            "SIGINT and SIGTERM while `turbopi serve` starts",
            "ended without a traceback or a fatal error",
            Size(20, few=2),
            2.5,
            _alone(endings.early_signals),
        ),
        Attack(
            "disks",
            "outputs of infer, calibrate, eval, convert, bench, demo and recordings to a full disk",
            "the earlier output survives, one line names the file",
            Size(4),
            4.0,
            _alone(disks.disks),
        ),
        Attack(
            "files",
            "damaged files of every format that is read",
            "one clear line, or the same numbers",
            Size(150, pieces=4, few=3),
            5.0,
            _alone(files.files),
            timed=False,
        ),
        Attack(
            "commands",
            "absurd command lines",
            "exit code 0, 1 or 2, no traceback, bounded time and memory",
            Size(100, pieces=5, few=20),
            5.0,
            _alone(commands.commands),
            timed=False,
        ),
    )
}
