"""Ends: clients that never read, clients and servers that are killed, and what a recording holds afterwards."""

import asyncio
import json
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from attack.arena import Arena, Found, Tick
from attack.judging import Bar, digest_actions
from attack.messages import observation
from attack.server import GoodClient, ServerProcess, environment
from attack.websocket import PING, Raw, frame, header
from turbopi.realtime.wire import pack
from turbopi.recordings import load_call
from turbopi.support.errors import TurboPiError

END_S = 20.0  # a SIGTERM is obeyed within, whatever clients do
WAIT_S = 60.0  # after which a server that doesn't end is killed

_KILLED_CLIENT = """
import socket, sys
s = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
s.sendall(bytes.fromhex(sys.argv[2]))
print("sent", flush=True)
s.recv(1 << 30)
while True: s.sendall(bytes(65536))
"""


def never_readers(seed: int, rounds: int, folder: Path, found: Found, tick: Tick) -> None:
    """Clients that read no answer and no pong; then SIGTERM or SIGINT."""
    draw, worst = random.Random(seed), 0.0
    for number in range(rounds):
        with ServerProcess("fake:5", folder=folder) as server:
            held = asyncio.run(_stuff(server.port, 1 + number % 5, draw))
            sent = signal.SIGTERM if number % 2 == 0 else signal.SIGINT
            took = server.end(sent, WAIT_S)
            for one in held:
                one.close()
            found.count += 1
            found.outcomes[f"{sent.name}: {'killed' if took is None else 'ended'} {server.process.returncode}"] += 1
            if took is None or took > END_S:
                said = f"more than {WAIT_S:.0f}" if took is None else f"{took:.1f}"
                found.violate(
                    f"{sent.name} took {said} s", f"{' '.join(server.command)}  # and clients that never read"
                )
            elif server.process.returncode != 0:
                found.violate(f"exit code {server.process.returncode} after {sent.name}", server.text()[-300:])
            worst = max(worst, WAIT_S if took is None else took)
            tick((number + 1) / rounds)
    found.bars.append(Bar("worst s to end", round(worst, 2), END_S))


async def _stuff(port: int, clients: int, draw: random.Random) -> list[socket.socket]:
    """Sockets full of answers that nobody reads. They outlive the event loop."""
    wire = frame(pack({**observation(draw), "attack_reply_bytes": 2**22}))
    held = []
    for _ in range(clients):
        raw = await Raw.open(port, limit=2**12)
        raw.writer.write(wire * 3 + frame(bytes(125), PING) * 2000)
        held.append(raw.writer.get_extra_info("socket").dup())
    await asyncio.sleep(1)
    return held


async def killed_clients(arena: Arena) -> None:
    """Processes that die by SIGKILL in the middle of a message, and sockets that are reset there."""
    from attack.websocket import request

    message = pack(observation(arena.random))
    starts = (
        request(arena.port)[:60],
        request(arena.port),
        request(arena.port) + frame(message)[:-4],
        request(arena.port) + frame(message),
        request(arena.port) + header(30_000_000) + bytes(1000),
    )
    for number in range(arena.count):
        start = starts[number % len(starts)]
        if number % 2:
            command = [sys.executable, "-S", "-c", _KILLED_CLIENT, str(arena.port), start.hex()]
            client = subprocess.Popen(command, stdout=subprocess.PIPE)
            assert client.stdout is not None
            await asyncio.to_thread(client.stdout.readline)
            await asyncio.sleep(arena.random.random() * 0.05)
            client.kill()
            client.communicate()
        else:
            with socket.create_connection(("127.0.0.1", arena.port)) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                one.sendall(start)
                await asyncio.sleep(arena.random.random() * 0.02)
        arena.found.count += 1
        arena.found.outcomes["killed" if number % 2 else "reset"] += 1
        arena.tick((number + 1) / arena.count)


def killed_servers(seed: int, rounds: int, folder: Path, found: Found, tick: Tick) -> None:
    """Servers that record are ended by SIGTERM, SIGINT or SIGKILL at random moments; their recordings are read back."""
    draw = random.Random(seed)
    for number in range(rounds):
        sent = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)[number % 3]
        with tempfile.TemporaryDirectory(dir=folder) as recording:
            _kill_server(sent, 0.3 + draw.random(), Path(recording), folder, found)
        tick((number + 1) / rounds)


def _kill_server(sent: signal.Signals, after: float, recording: Path, folder: Path, found: Found) -> None:
    with (
        ServerProcess("fake:2", ["--record", str(recording)], folder=folder) as server,
        GoodClient(server.port, folder, pixels=64) as good,
    ):
        time.sleep(after)
        took = server.end(sent, WAIT_S)
        answered = sum(said == "ok" for _, said in good.requested(0, float("inf")))
    line = f"{' '.join(server.command)}  # {sent.name}"
    found.count += 1
    found.outcomes[f"{sent.name}: exit {server.process.returncode}"] += 1
    if took is None:
        found.violate(f"{sent.name} took more than {WAIT_S:.0f} s", line)
    elif sent != signal.SIGKILL and server.process.returncode != 0:
        found.violate(f"exit code {server.process.returncode} after {sent.name}", line)
    calls = check_recording(recording, killed=sent == signal.SIGKILL, fault=lambda what: found.violate(what, line))
    found.outcomes["calls read back"] += calls
    if sent != signal.SIGKILL and calls < answered:
        found.violate(f"{answered} answers were sent, {calls} calls recorded", line)


def check_recording(folder: Path, *, killed: bool, fault: Callable[[str], None]) -> int:
    """The number of calls below a --record folder whose answer is the digest of their observation.

    Calls `fault` with each thing that is wrong. A server that was `killed` may leave a last call without its line in
    the index, a last line in half, and a temporary file.
    """
    calls, unlisted = 0, 0
    for run in sorted(path for path in folder.iterdir() if path.is_dir()):
        try:
            json.loads((run / "manifest.json").read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            fault(f"{run.name}/manifest.json: {error}")
        listed = _listed(run / "index.jsonl", killed, fault)
        for file in sorted(run.glob("*.npz")):
            if file.name.startswith("."):
                continue
            try:
                call = load_call(file)
            except (TurboPiError, OSError) as error:
                fault(f"{file.name} can't be read back: {error}")
                continue
            if not np.array_equal(call.result["actions"], digest_actions(call.observation)):
                fault(f"{file.name}: its actions belong to another observation")
            calls += 1
            unlisted += file.name not in listed
        missing = sorted(name for name in listed if not (run / name).exists())
        if missing:
            fault(f"the index lists {missing[:3]}, which aren't there")
        left = [
            path.name for path in run.iterdir() if not re.fullmatch(r"\d+\.npz|index\.jsonl|manifest\.json", path.name)
        ]
        if left and not killed:
            fault(f"left behind: {left[:3]}")
    if unlisted > (1 if killed else 0):
        fault(f"{unlisted} calls aren't in the index")
    return calls


def _listed(index: Path, killed: bool, fault: Callable[[str], None]) -> set[str]:
    """The files that an index names."""
    if not index.exists():
        return set()
    text, names = index.read_text(encoding="utf-8", errors="replace"), set()
    lines = text.split("\n")
    for number, line in enumerate(lines):
        if not line:
            continue
        try:
            names.add(str(json.loads(line)["file"]))
        except (ValueError, KeyError, TypeError):
            if not (killed and number == len(lines) - 1):
                fault(f"line {number + 1} of index.jsonl isn't JSON: {line[:60]!r}")
    return names


def early_signals(seed: int, rounds: int, folder: Path, found: Found, tick: Tick) -> None:
    """SIGINT or SIGTERM while `turbopi serve` starts: it ends soon, without a traceback or a fatal error."""
    draw = random.Random(seed)
    from attack.server import command

    for number in range(rounds):
        sent = signal.SIGINT if number % 2 else signal.SIGTERM
        moment = draw.uniform(0.05, 6.0)
        line = f"kill -{sent.name} after {moment:.2f} s: {' '.join(command('pi05_tiny'))}"
        log = folder / f"early-{seed}-{number}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                command("pi05_tiny"), stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT, env=environment()
            )
            time.sleep(moment)
            process.send_signal(sent)
            try:
                code = process.wait(WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
                found.violate(f"{sent.name} took more than {WAIT_S:.0f} s", line)
        text = log.read_text(errors="replace")
        found.count += 1
        found.outcomes[f"{sent.name}: exit {code}"] += 1
        if "Traceback" in text or "Fatal Python error" in text:
            found.violate(f"{sent.name}: {' '.join(text.split())[-300:]}", line)
        tick((number + 1) / rounds)
