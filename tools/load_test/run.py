"""Starts the processes of clients, lets them begin together, and puts what they noted into one document."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import torch

from load_test.client_process import Job
from load_test.connections import Kind
from load_test.document import Clients, Load, LoadDocument, ProcessUse, summary
from load_test.observations import observations, shapes
from load_test.schedule import Arrivals, Request
from turbopi.realtime.client import RealTimeClient
from turbopi.realtime.wire import pack
from turbopi.support.errors import ConfigError
from turbopi.support.provenance import provenance

HERE = Path(__file__).resolve().parents[2]
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A load test.

    url           ws://HOST:PORT, or wss://
    rate          requests a second of all clients together, for "fixed" and "poisson"
    processes     that the clients are spread over; None: one each
    drain_s       seconds after the end in which requests that were due are still sent
    robot         a name or a .json; None: the one that the server's metadata names
    observation   instead, the file or folder of one
    images      height and width of all images; None: the robot's own
    python        the interpreter of the clients; None: this one
    """

    url: str
    api_key: str | None = None
    client: Kind = "turbopi"
    arrivals: Arrivals = "closed"
    rate: float | None = None
    clients: int = 1
    processes: int | None = None
    seconds: float = 20.0
    warmup: float = 3.0
    drain_s: float = 5.0
    answer_s: float = 30.0
    seed: int = 0
    robot: str | None = None
    observation: Path | None = None
    camera_images: tuple[int, int] | None = None
    python: str | None = None

    def check(self) -> None:
        """Raises ConfigError for what can't be."""
        if (self.rate is None) != (self.arrivals == "closed"):
            raise ConfigError("an open loop needs a rate, and a closed loop has none")
        if self.rate is not None and not 0 < self.rate <= 1e5:
            raise ConfigError(f"the rate is {self.rate:g} requests a second; expected more than 0, at most 100000")
        if not 1 <= self.clients <= 1000:
            raise ConfigError(f"--clients is {self.clients}; expected 1 to 1000")
        if self.processes is not None and not 1 <= self.processes <= self.clients:
            raise ConfigError(f"--processes is {self.processes}; expected 1 to {self.clients}, the clients")
        for name, value, least in (("seconds", self.seconds, 0.1), ("warmup", self.warmup, 0.0)):
            if not least <= value <= 86400:
                raise ConfigError(f"--{name} is {value:g}; expected {least:g} to 86400")
        if not self.url.startswith(("ws://", "wss://")):
            raise ConfigError(f"{self.url}: expected ws://HOST:PORT or wss://HOST")


class _Process:
    """A process of clients."""

    def __init__(self, job: Job, folder: Path, name: str, wanted: Wanted) -> None:
        self.out = Path(job.out)
        file = folder / f"{name}.job"
        file.write_text(job.text())
        path = os.pathsep.join((str(HERE / "tools"), str(HERE / "src"), os.environ.get("PYTHONPATH", "")))
        words = [wanted.python or sys.executable, "-m", "load_test.client_process", str(file)]
        environment = {**os.environ, "PYTHONPATH": path.rstrip(os.pathsep)}
        self._errors = (folder / f"{name}.stderr").open("w+")
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._errors}
        self._process = subprocess.Popen(words, **pipes, text=True, env=environment)
        self._say(json.dumps(wanted.api_key))

    def ready(self) -> None:
        """Wait until its clients are connected."""
        assert self._process.stdout is not None
        if not self._process.stdout.readline():
            self._fail()

    def begin(self) -> None:
        self._say("begin")

    def ended(self) -> tuple[ProcessUse, dict[int, list[Request]]]:
        """Wait for its end: how busy it was, and the requests of each of its clients."""
        if self._process.wait() != 0:
            self._fail()
        noted = json.loads(self.out.read_text())
        requests = {int(client): [Request(*one) for one in made] for client, made in noted["requests"].items()}
        return ProcessUse(**noted["use"]), requests

    def stop(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout, self._errors):
            if pipe is not None:
                pipe.close()
        self._process.kill()
        self._process.wait()

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self._fail()

    def _fail(self) -> NoReturn:
        self._process.wait()
        self._errors.seek(0)
        last = (self._errors.read().strip().splitlines() or ["it said nothing"])[-1]
        raise ConfigError(f"a process of clients ended: {last}")


def run(wanted: Wanted, command: Sequence[str]) -> LoadDocument:
    """Test, and return what came out. Raises ConfigError, and ServerLost if nobody answers at the URL."""
    wanted.check()
    with RealTimeClient(wanted.url, api_key=wanted.api_key) as probe:  # openpi-client would wait for ever
        server = probe.metadata
    robot = wanted.robot or server.get("robot")
    if wanted.observation is None and not isinstance(robot, str):
        raise ConfigError("the server's metadata names no robot: say with --robot or --observation what to send")
    name, made = observations(robot, wanted.observation, wanted.camera_images, wanted.clients, wanted.seed)
    count = wanted.processes or wanted.clients
    with tempfile.TemporaryDirectory() as text, ExitStack() as stack:
        folder = Path(text)
        files: dict[int, list[str]] = {}
        for client, own in enumerate(made):
            files[client] = [str(folder / f"{client}_{number}.msgpack") for number in range(len(own))]
            for file, observation in zip(files[client], own, strict=True):
                Path(file).write_bytes(pack(observation))
        processes = []
        for number in range(count):
            job = _job(wanted, list(range(number, wanted.clients, count)), files, folder / f"{number}.out")
            processes.append(_Process(job, folder, str(number), wanted))
            stack.callback(processes[-1].stop)
        for process in processes:
            process.ready()
        before = _load_average()
        for process in processes:
            process.begin()
        uses, by_client = list[ProcessUse](), dict[int, list[Request]]()
        for process in processes:
            use, requests = process.ended()
            uses.append(use)
            by_client |= requests
    load = Load(
        url=wanted.url,
        client=wanted.client,
        arrivals=wanted.arrivals,
        clients=wanted.clients,
        processes=count,
        rate=wanted.rate,
        seconds=wanted.seconds,
        warmup_seconds=wanted.warmup,
        seed=wanted.seed,
        robot=name,
        camera_images=[(int(a), int(b), int(c)) for a, b, c in shapes(made[0][0])],
        message_bytes=len(pack(made[0][0])),
    )
    fields = summary([by_client[client] for client in sorted(by_client)], load)
    after = _load_average()
    average = None if before is None or after is None else (before, after)
    clients = Clients(processes=uses, cpus=os.cpu_count() or 1, load_average=average)
    where = provenance(_device(wanted.url, server))
    return LoadDocument(
        kind="turbopi-load",
        provenance=where,
        command=list(command),
        load=load,
        server=_without_folders(_plain(server)),
        clients=clients,
        **fields,  # type: ignore[arg-type]
    )


def _job(wanted: Wanted, clients: list[int], files: Mapping[int, list[str]], out: Path) -> Job:
    until = wanted.warmup + wanted.seconds
    return Job(
        url=wanted.url,
        kind=wanted.client,
        answer_s=wanted.answer_s,
        arrivals=wanted.arrivals,
        clients=clients,
        of=wanted.clients,
        rate=wanted.rate or 0.0,
        until_s=until,
        end_s=until + wanted.drain_s,
        seed=wanted.seed,
        observations={str(client): files[client] for client in clients},
        out=str(out),
    )


def _load_average() -> float | None:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def _device(url: str, server: Mapping[str, Any]) -> torch.device:
    """The server's GPU if it runs on this machine, else the CPU, which the clients run on."""
    device = str(server.get("device", "cpu"))
    here = url.partition("//")[2].rpartition(":")[0] in LOOPBACK
    return torch.device(device if here and device.startswith("cuda") and torch.cuda.is_available() else "cpu")


def _without_folders(server: dict[str, Any]) -> dict[str, Any]:
    """Its tokenizer by its file's name: where that lies on the server's machine is nobody else's business."""
    tokenizer = server.get("tokenizer")
    return server | {"tokenizer": Path(tokenizer).name} if isinstance(tokenizer, str) else server


def _plain(value: Any) -> Any:
    """A server's metadata as JSON holds it."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and value != value:
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)
