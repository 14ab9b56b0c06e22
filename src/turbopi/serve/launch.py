"""What `turbopi serve` does once it has a policy."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape

from turbopi.serve.calls import Policy
from turbopi.serve.server import PolicyServer

_LOOPBACK = ("127.0.0.1", "::1", "localhost")


def run(
    policy: Policy,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    api_key: str | None = None,
    max_message_mb: float = 64,
    queue_limit: int = 16,
    record_dir: str | Path | None = None,
    console: Console | None = None,
) -> None:
    """Warm `policy` up, print the address, and serve until SIGINT or SIGTERM. Options as PolicyServer's.

    Raises ConfigError for an option that can't be right, a port that is taken, a folder that can't be written.
    """
    console = Console() if console is None else console
    server = PolicyServer(
        policy,
        host=host,
        port=port,
        api_key=api_key,
        max_message_mb=max_message_mb,
        queue_limit=queue_limit,
        record_dir=record_dir,
    )
    if host not in _LOOPBACK and api_key is None:
        console.print(f"[yellow]Anyone who can reach {escape(host)} can use this policy: --api-key protects it.[/]")
    if hasattr(policy, "warmup"):
        console.print("Warming up …")

    def ready(server: PolicyServer) -> None:
        http = escape(server.url.replace("ws://", "http://"))
        console.print(f"Serving at [bold]{escape(server.url)}[/]   health {http}/healthz   metrics {http}/metrics")
        if server.recording is not None:
            console.print(f"Recording to {escape(str(server.recording))}")
        console.print("Ctrl-C stops.")

    def stopping(server: PolicyServer) -> None:
        console.print("Stopping, after the running inference. Ctrl-C again doesn't wait.")

    server.serve_forever(ready, stopping)
    console.print("Stopped.")
