"""A whole fleet as one Ray Serve application, for clusters that are run with Ray's own commands:

    serve run turbopi.serve.fleet.ray_app:build checkpoint=/srv/pi05_libero config=pi05_libero

The replicas are those of fleet.py. The server in front of them is a deployment, too (`Ingress`): Ray Serve's HTTP proxy
takes a robot's websocket to it, and what comes is passed on, frame by frame, to a PolicyServer of the same process, on
the loopback interface. So the protocol is the one of `turbopi serve`, to the letter. What Ray's proxy adds to it:
messages above 16 MB are refused, and some milliseconds. docs/fleet.md has the rest.
"""

import asyncio
import contextlib
import json
import os
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
from websockets.asyncio.client import ClientConnection, connect
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.frames import CloseCode

from turbopi.config import typed_grid
from turbopi.realtime.running_chunk import JoinMode
from turbopi.serve.calls import Policy
from turbopi.serve.fleet.fleet import QUIET, Fleet, FleetOptions, import_ray, line_of, replicas
from turbopi.serve.fleet.fleet import connect as join_cluster
from turbopi.serve.options import ServerOptions, key_in
from turbopi.serve.server import PolicyServer
from turbopi.support.errors import ConfigError

Scope = Mapping[str, Any]
Receive = Callable[[], Awaitable[dict[str, Any]]]
Send = Callable[[dict[str, Any]], Awaitable[None]]

PROXY_MB = 16.0  # of a message: what Ray Serve's proxy takes
AHEAD_BYTES = 64 * 2**20  # that a client may send while its requests wait: Ray's proxy reads all that comes
PASSED_ON = ("authorization", "origin")  # by these and Host a server on loopback decides who may connect (hosts.py)
HTTP_SECONDS = 30.0
CLOSE_SECONDS = 1.0  # for the server to see that a client has left, before the connection is cut


class Arguments(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What `build` takes: options of `turbopi serve` under the same names, and of the fleet (fleet.FleetOptions)."""

    checkpoint: str | None = None
    random_weights: str | None = None
    weights_seed: int = 0
    config: str = "auto"
    robot: str | None = None
    backend: str = "auto"
    precision: str = "bf16"
    quantization: str | None = None
    steps: int | None = None
    solver: str | None = None
    time_grid: str | None = None
    guidance: float | None = None
    guidance_tag: str | None = None
    device: str = "auto"
    tokenizer: str | None = None
    default_prompt: str | None = None
    out_of_range: str = "warn"
    known_cameras: str | None = None
    strict: bool = False
    warmup: bool = True
    replicas: int | None = None
    cpus: float = 1.0
    autoscaling: dict[str, Any] | str | None = None
    queue_limit: int = ServerOptions.queue_limit
    max_batch: int | None = None
    deadline_ms: float = ServerOptions.deadline_ms
    answer_seconds: float = FleetOptions.answer_seconds
    api_key_file: str | None = None
    allowed_hosts: str = ""
    max_message_mb: float = PROXY_MB
    max_clients: int = ServerOptions.max_clients
    record: str | None = None
    execution: JoinMode | None = None
    control_hz: float | None = None
    execution_horizon: int | None = None
    delay_steps: int | None = None

    def make_policy(self) -> Policy:
        """In the replica."""
        from turbopi.checkpoint import open_checkpoint, random_checkpoint
        from turbopi.policy.policy import UnifiedPolicy

        if self.random_weights is not None:
            opened = random_checkpoint(self.random_weights, self.weights_seed, self.config)
        else:
            assert self.checkpoint is not None
            opened = open_checkpoint(self.checkpoint, self.config)
        return UnifiedPolicy(
            opened,
            backend=self.backend,
            precision=self.precision,  # type: ignore[arg-type]  # checked there
            quantization=self.quantization,
            num_denoising_steps=self.steps,
            solver=self.solver,  # type: ignore[arg-type]  # checked there
            time_grid=typed_grid(self.time_grid),
            guidance=self.guidance,
            guidance_tag=self.guidance_tag,
            device=self.device,
            tokenizer=self.tokenizer,
            default_prompt=self.default_prompt,
            robot=self.robot,
            strict=self.strict,
            out_of_range=self.out_of_range,  # type: ignore[arg-type]  # checked there
            known_cameras=self.known_cameras,
        )

    def fleet(self) -> FleetOptions:
        return FleetOptions(
            name="turbopi",
            checkpoint=name_of(self.checkpoint, self.random_weights),
            replicas=self.replicas,
            use_gpus=gpus_for(self.device),
            cpus=self.cpus,
            autoscaling=read_autoscaling(self.autoscaling),
            line=line_of(self.server()),
            answer_seconds=self.answer_seconds,
        )

    def server(self) -> ServerOptions:
        """Of the server behind Ray's proxy: on loopback, with a port of its own, without a page."""
        if self.max_message_mb > PROXY_MB:
            value = f"max_message_mb={self.max_message_mb:g} was asked for"
            raise ConfigError(f"{value}, but Ray Serve's proxy takes {PROXY_MB:g} MB")
        return ServerOptions(
            port=0,
            api_key=None if self.api_key_file is None else key_in(Path(self.api_key_file)),
            max_message_mb=self.max_message_mb,
            queue_limit=self.queue_limit,
            max_batch=self.max_batch,
            deadline_ms=self.deadline_ms,
            record_dir=self.record,
            allowed_hosts=[name.strip() for name in self.allowed_hosts.split(",") if name.strip()],
            max_clients=self.max_clients,
            page=False,
            execution=self.execution,
            control_hz=self.control_hz,
            execution_horizon=self.execution_horizon,
            delay_steps=self.delay_steps,
        )


def build(arguments: dict[str, Any]) -> Any:
    """The application. `arguments` are the `key=value` of `serve run`, or `args` of Ray Serve's configuration file.

    Raises ConfigError for arguments that can't be right.
    """
    _, serve = import_ray()
    try:
        given = msgspec.convert(arguments, Arguments, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"turbopi.serve.fleet.ray_app:build: {error}; it takes {', '.join(Arguments.__struct_fields__)}"
        ) from error
    if (given.checkpoint is None) == (given.random_weights is None):
        raise ConfigError("give one of checkpoint=FOLDER and random_weights=PRESET")
    if os.environ.get("TURBOPI_API_KEY") and given.api_key_file is None:  # it wouldn't reach the server's process
        raise ConfigError("TURBOPI_API_KEY is set, but a cluster takes the key from a file: api_key_file=FILE")
    given.server()  # a mistake shall show here, not in a log of the cluster
    join_cluster()  # whose GPUs are counted: `serve run` calls this before it joins
    warm = warm_up_of(given.warmup, given.execution)
    ingress = serve.deployment(
        name="ingress",
        ray_actor_options={"num_cpus": 0},
        max_ongoing_requests=given.max_clients + 32,  # each websocket is one; health checks and metrics besides
        max_surge_percent=100,
        logging_config=QUIET,
    )(serve.ingress()(Ingress))
    return ingress.bind(replicas(given.make_policy, given.fleet(), warm=warm), given)


def name_of(checkpoint: str | None, random_weights: str | None) -> str:
    """What a fleet is called if nobody says it: the checkpoint folder's name, or the preset's.

    A name of digits alone is that of a training step, which every run has: its parent's comes in front.
    """
    name = random_weights
    if checkpoint is not None:
        folder = Path(checkpoint).resolve()
        name = f"{folder.parent.name}-{folder.name}" if folder.name.isdigit() and folder.parent.name else folder.name
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name or "turbopi")


def gpus_for(device: str) -> bool | None:
    """FleetOptions' `use_gpus` for a device. Raises ConfigError for a GPU by number: Ray gives each replica its own."""
    if device in ("cuda", "cpu"):
        return device == "cuda"
    if device != "auto":
        raise ConfigError(
            f"device={device!r} was asked for, but in a fleet Ray gives each replica its GPU: cuda, cpu or auto"
        )
    return None


def read_autoscaling(value: Mapping[str, Any] | str | None) -> Mapping[str, Any] | None:
    """Ray Serve's `autoscaling_config`, which may have been given as JSON. What is in it, Ray Serve checks."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except ValueError as error:
            raise ConfigError(
                f'autoscaling= takes JSON such as {{"min_replicas": 1, "max_replicas": 4}}: {error}'
            ) from error
        if not isinstance(value, dict):
            raise ConfigError(f"autoscaling= takes a JSON object, not {value!r}")
    return value


def warm_up_of(wanted: bool, execution: str | None) -> dict[str, Any] | None:
    """Replica's `warm`."""
    return None if not wanted else {} if execution is None else {"real_time": execution}


@dataclass
class _Ahead:
    """Frames that came and weren't passed on yet."""

    frames: deque[str | bytes]
    bytes: int = 0


class Ingress:
    """The server in front, behind Ray Serve's proxy, which calls it as an ASGI application."""

    async def __init__(self, policies: Any, arguments: Arguments) -> None:  # type: ignore[misc]  # Ray Serve awaits it
        _, serve = import_ray()
        about = await policies.about.remote()
        fleet = Fleet(policies, serve.get_replica_context().app_name, about, arguments.answer_seconds)
        self._server = PolicyServer(fleet, arguments.server(), calls=fleet.calls)
        await self._server.start()

    async def __del__(self) -> None:
        await self._server.stop()

    def __serve_build_asgi_app__(self) -> Callable[[Scope, Receive, Send], Awaitable[None]]:
        return relay(lambda: self._server.port)


def relay(port: Callable[[], int]) -> Callable[[Scope, Receive, Send], Awaitable[None]]:
    """An ASGI application that passes all on to the policy server on that port of this machine."""

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            for what in ("startup", "shutdown"):
                await receive()
                await send({"type": f"lifespan.{what}.complete"})
        elif scope["type"] == "http":
            await _http(port(), scope, send)
        elif scope["type"] == "websocket":
            await _websocket(port(), scope, receive, send)

    return application


def _target(scope: Scope) -> str:
    query = scope.get("query_string", b"").decode("latin-1")
    return quote(scope["path"]) + (f"?{query}" if query else "")


def _headers(scope: Scope, names: tuple[str, ...]) -> list[tuple[str, str]]:
    given = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]
    return [(name, value) for name, value in given if name in names]


async def _http(port: int, scope: Scope, send: Send) -> None:
    """/healthz, /metrics, and what the server says to all else; GET alone, as there."""
    if scope.get("method", "GET") != "GET":
        await send({"type": "http.response.start", "status": 405, "headers": [(b"allow", b"GET")]})
        await send({"type": "http.response.body", "body": b""})
        return

    def get() -> tuple[int, list[tuple[str, str]], bytes]:
        connection = HTTPConnection("127.0.0.1", port, timeout=HTTP_SECONDS)
        try:
            connection.putrequest("GET", _target(scope), skip_host=True, skip_accept_encoding=True)
            for name, value in _headers(scope, ("host", *PASSED_ON)):
                connection.putheader(name, value)
            connection.endheaders()
            answer = connection.getresponse()
            return answer.status, answer.getheaders(), answer.read()
        finally:
            connection.close()

    status, headers, body = await asyncio.to_thread(get)
    passed = [(n.lower().encode("latin-1"), v.encode("latin-1")) for n, v in headers if n.lower() != "connection"]
    await send({"type": "http.response.start", "status": status, "headers": passed})
    await send({"type": "http.response.body", "body": body})


async def _websocket(port: int, scope: Scope, receive: Receive, send: Send) -> None:
    """One robot: the server lets it in or says why not; then frames go both ways until one side closes."""
    await receive()  # websocket.connect
    host = dict(_headers(scope, ("host",))).get("host", "127.0.0.1")
    try:
        server = await connect(
            f"ws://{host}{_target(scope)}",
            host="127.0.0.1",
            port=port,
            additional_headers=Headers(_headers(scope, PASSED_ON)),
            compression=None,
            max_size=None,
            ping_interval=None,
            close_timeout=CLOSE_SECONDS,
            user_agent_header=None,
            proxy=None,
        )
    except InvalidStatus as refusal:
        response = refusal.response
        headers = [(b"content-type", b"text/plain; charset=utf-8")]
        await send({"type": "websocket.http.response.start", "status": response.status_code, "headers": headers})
        await send({"type": "websocket.http.response.body", "body": response.body or b""})
        return
    except (OSError, WebSocketException):
        await send({"type": "websocket.close", "code": CloseCode.TRY_AGAIN_LATER, "reason": "the server is stopping"})
        return
    async with server:
        await send({"type": "websocket.accept"})
        ahead, came = _Ahead(deque()), asyncio.Event()
        tasks = [
            asyncio.ensure_future(work)
            for work in (_take(receive, ahead, came), _pass_on(server, ahead, came), _answer(server, send))
        ]
        done, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()
        await asyncio.gather(*pending, return_exceptions=True)
        code, reason = next(iter(done)).result()
    if code is not None:
        with contextlib.suppress(Exception):  # it has left
            await send({"type": "websocket.close", "code": code, "reason": reason})


Ending = tuple[int | None, str]  # the code and reason to close with; no code: the client has left


async def _take(receive: Receive, ahead: _Ahead, came: asyncio.Event) -> Ending:
    """Take what the client sends as it comes, so that it waits here, where it is counted."""
    while True:
        event = await receive()
        if event["type"] == "websocket.disconnect":
            return None, ""
        frame = event.get("bytes")
        frame = event["text"] if frame is None else frame
        ahead.frames.append(frame)
        ahead.bytes += len(frame)
        if ahead.bytes > AHEAD_BYTES:
            return CloseCode.POLICY_VIOLATION, "too much was sent while earlier requests waited: await each answer"
        came.set()


async def _pass_on(server: ClientConnection, ahead: _Ahead, came: asyncio.Event) -> Ending:
    """Send it on, no faster than the server takes it."""
    while True:
        while ahead.frames:
            frame = ahead.frames[0]
            try:
                await server.send(frame)
            except ConnectionClosed:
                await asyncio.Event().wait()  # `_answer` sees it, with all that the server said before
            ahead.frames.popleft()
            ahead.bytes -= len(frame)
        came.clear()
        await came.wait()


async def _answer(server: ClientConnection, send: Send) -> Ending:
    """What the server sends, to the client; and how it closes."""
    try:
        while True:
            frame = await server.recv()
            kind = "text" if isinstance(frame, str) else "bytes"
            await send({"type": "websocket.send", kind: frame})
    except ConnectionClosed as closed:
        code = CloseCode.INTERNAL_ERROR if closed.rcvd is None else closed.rcvd.code
        return code, "" if closed.rcvd is None else closed.rcvd.reason
