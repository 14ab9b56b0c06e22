"""The shipped loops when their server is killed, stopped, slow or cut off: they hold, and go on with new images alone.

The server is a process of its own whose policy answers each observation's `taken` with actions of (taken, now), both of
time.monotonic, which processes share. So each command shows how old it was when it was answered.
"""

import contextlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from turbopi.realtime import Command, RealTimeExecutor

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
AGE = 1.5  # seconds: the oldest image that may act
PATIENCE = 120.0

SERVER = """
import sys, time
from pathlib import Path
import numpy as np
from turbopi import serve

class Policy:
    metadata = {"robot": "none"}

    def infer(self, obs):
        taken = float(obs["taken"])
        time.sleep(float(Path(sys.argv[2]).read_text() or 0))
        actions = np.tile([taken, time.monotonic(), 0, 0, 0, 0, 0], (10, 1))
        return {"actions": actions, "named_actions": {f"joint_{i}.pos": actions[:, i] for i in range(7)}}

serve.run(Policy(), port=int(sys.argv[1]), page=False)
"""


class Server:
    """A policy server's process. Between it and the robot there is a network, which can be cut."""

    def __init__(self, folder: Path) -> None:
        self.slow = folder / "seconds"
        self.slow.write_text("0")
        self._port = free_port()
        self._network = Network(self._port)
        self.port = self._network.port
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-c", SERVER, str(self._port), str(self.slow)]
        self.process = subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": str(ROOT / "src")}, stdout=subprocess.DEVNULL
        )

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def slow_down(self) -> None:
        self.slow.write_text(str(2 * AGE))

    def speed_up(self) -> None:
        self.slow.write_text("0")

    def cut(self) -> None:
        self._network.cut()

    def mend(self) -> None:
        self._network.mend()

    def close(self) -> None:
        self.go_on()
        self.kill()
        self._network.close()


class Network:
    """Hands bytes on between clients of its port and a server; cut off, it ends all connections and takes none."""

    def __init__(self, target: int) -> None:
        self._target, self._open = target, True
        self._ends: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._open = False
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._ends.clear()

    def mend(self) -> None:
        self._open = True

    def close(self) -> None:
        self._listener.close()
        self.cut()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # it is closed
            while True:
                near = self._listener.accept()[0]
                try:
                    if not self._open:
                        raise ConnectionRefusedError
                    far = socket.create_connection(("127.0.0.1", self._target))
                except OSError:
                    near.close()
                    continue
                self._ends += [near, far]
                for source, target in ((near, far), (far, near)):
                    threading.Thread(target=self._hand_on, args=(source, target), daemon=True).start()

    def _hand_on(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                target.sendall(data)
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


class Seen:
    """The commands of a loop, in order: (kind, the action's first two numbers)."""

    def __init__(self) -> None:
        self.commands: list[tuple[str, list[float]]] = []
        self.held_at_the_end = self.ending = False

    def add(self, kind: str, action: Any = None) -> None:
        self.held_at_the_end = False
        numbers = [float(value) for value in action[:2]] if kind == "fresh" else []
        self.commands.append((kind, numbers))

    def observation(self, keys: dict[str, Any]) -> dict[str, Any]:
        if self.ending:
            raise KeyboardInterrupt
        return keys | {"taken": time.monotonic()}

    def wait_for(self, kind: str) -> None:
        """A command of this kind that comes from now on."""
        seen, end = len(self.commands), time.monotonic() + PATIENCE
        while not any(command[0] == kind for command in self.commands[seen:]):
            assert time.monotonic() < end, f"no {kind} command came; the last ones: {self.commands[-5:]}"
            time.sleep(0.01)


def loaded(name: str, seen: Seen, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """An example as a module, with `seen` in its arm's place."""
    monkeypatch.syspath_prepend(str(ROOT / "tests" / "openpi_stand_in"))
    described = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert described is not None and described.loader is not None
    module: Any = importlib.util.module_from_spec(described)
    described.loader.exec_module(module)

    class Executor(RealTimeExecutor):
        def next_action(self) -> Command:
            command = super().next_action()
            seen.add(command.kind, command.action)
            return command

    class Arm:
        def observe(self) -> dict[str, Any]:
            return seen.observation({})

        def move(self, action: np.ndarray) -> None:
            if name == "openpi_loop":
                seen.add("fresh", action)

        def hold(self) -> None:
            if name == "openpi_loop":
                seen.add("held")
            seen.held_at_the_end = True

    class SO101(module.FakeSO101 if name == "lerobot_so101" else object):  # type: ignore[misc]
        def get_observation(self) -> dict[str, Any]:
            return seen.observation({})

        def disconnect(self) -> None:
            seen.held_at_the_end = True

    for one, ours in (("RealTimeExecutor", Executor), ("Arm", Arm), ("FakeSO101", SO101)):
        if hasattr(module, one):
            monkeypatch.setattr(module, one, ours)
    return module


@contextlib.contextmanager
def looping(main: Callable[[], None], seen: Seen) -> Iterator[None]:
    """The loop on a thread; at the end Ctrl-C comes."""
    failures: list[BaseException] = []

    def run() -> None:
        try:
            main()
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        seen.ending = True
        thread.join(PATIENCE)
    assert not thread.is_alive() and not failures, failures


@pytest.mark.parametrize("example", ["robot_loop", "openpi_loop", "lerobot_so101"])
def test_a_server_that_fails_in_any_way_makes_the_arm_hold_and_go_on_with_new_images(
    example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, server = Seen(), Server(tmp_path)
    where = ["--server", f"ws://127.0.0.1:{server.port}"] if "so101" in example else ["--port", str(server.port)]
    options = [*where, "--steps", "1000000", "--age", str(AGE)]
    monkeypatch.setattr(sys, "argv", [example, *options])
    faults: list[tuple[Callable[[], None], Callable[[], None]]] = [
        (server.kill, server.start),
        (server.stop, server.go_on),
        (server.slow_down, server.speed_up),
        (server.cut, server.mend),
    ]
    try:
        with looping(loaded(example, seen, monkeypatch).main, seen):
            seen.wait_for("fresh")
            for begin, end in faults:
                begin()
                time.sleep(1.2 * AGE)  # now an answer to what was asked before is too old
                seen.wait_for("held")
                end()
                seen.wait_for("fresh")
    finally:
        server.close()
    fresh = [numbers for kind, numbers in seen.commands if kind == "fresh"]
    assert all(0 <= answered - taken <= AGE for taken, answered in fresh), "too old an image acted"
    assert seen.held_at_the_end, "after Ctrl-C the arm holds"
