"""Ways to run a server: `turbopi serve` once it has a policy, and a `with` block."""

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

import psutil
from rich.console import Console
from rich.markup import escape

from turbopi.serve.calls import Policy
from turbopi.serve.hosts import LOOPBACK
from turbopi.serve.options import ServerOptions
from turbopi.serve.server import PolicyServer


def run(policy: Policy, options: ServerOptions | None = None, *, console: Console | None = None, **given: Any) -> None:
    """Warm `policy` up, print the address, and serve until SIGINT or SIGTERM. `options` and `given` are PolicyServer's.

    Raises ConfigError for an option that can't be right, a port that is taken, a folder that can't be written; and
    DeviceLost when the GPU has failed for good: the process must end then, and a new one can serve.
    """
    console = Console() if console is None else console
    server = PolicyServer(policy, options, **given)

    def print_line(text: str) -> None:
        encoding = console.encoding  # of a stdout that may know ASCII alone
        console.print(text.encode(encoding, "backslashreplace").decode(encoding), soft_wrap=True)

    if server.host not in LOOPBACK and server.options.api_key is None:
        print_line(
            f"[yellow]Anyone who can reach {escape(server.host)} can use this policy: an API key protects it "
            "(TURBOPI_API_KEY or --api-key-file).[/]"
        )
    began, warms_up = time.perf_counter(), hasattr(policy, "warmup")
    if warms_up:
        print_line("Warming up …")

    def ready(server: PolicyServer) -> None:
        if warms_up:
            print_line(f"warm-up: {time.perf_counter() - began:.1f} s")
        first, *others = [f"ws://{name}:{server.port}" for name in addresses(server.host)] or [server.url]
        http = escape(first.replace("ws://", "http://"))
        print_line(f"Serving at [bold]{escape(first)}[/]")
        print_line(f"Health {http}/healthz, metrics {http}/metrics")
        if server.options.has_page:
            print_line(f"Page {http}/")
        if others:
            print_line(f"Also at {escape(', '.join(others))}")
        if server.joins is not None:
            print_line(escape(server.joins))
        if server.recording is not None:
            print_line(f"Recording to {escape(str(server.recording))}")
        print_line("Ctrl-C stops.")

    def stopping(server: PolicyServer) -> None:
        print_line("Stopping, after the running inference. Ctrl-C again doesn't wait.")

    server.serve_forever(ready, stopping)
    print_line("Stopped.")


def addresses(host: str) -> list[str]:
    """This machine's addresses, for a server that listens on all of them, loopback last; [] for another host."""
    if host not in ("0.0.0.0", "::", ""):
        return []
    families = (socket.AF_INET,) if host == "0.0.0.0" else (socket.AF_INET, socket.AF_INET6)
    states = psutil.net_if_stats()
    found = [
        f"[{one.address}]" if one.family is socket.AF_INET6 else one.address
        for name, ones in psutil.net_if_addrs().items()
        for one in ones
        if one.family in families and (name not in states or states[name].isup)
    ]
    return [*(name for name in found if not name.startswith(("127.", "[::1]", "[fe80:"))), "localhost"]


@contextlib.contextmanager
def running(policy: Policy, *, port: int = 0, **options: Any) -> Iterator[PolicyServer]:
    """A server in a background thread for the length of a `with` block. For tests, notebooks and demos.

    Takes PolicyServer's options; port 0 picks a free one. Raises what `start` raises.
    """
    server = PolicyServer(policy, port=port, **options)
    ready: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def main() -> None:
        stop = asyncio.Event()
        try:
            await server.start()
        except BaseException as error:
            ready.set_exception(error)
            return
        ready.set_result((asyncio.get_running_loop(), stop))
        await stop.wait()
        await server.stop()

    thread = threading.Thread(target=lambda: asyncio.run(main()), name="turbopi-server", daemon=True)
    thread.start()
    loop, stop = ready.result()
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
