"""Serving a policy over openpi's websocket protocol: `serve.run(policy)`, or PolicyServer inside an event loop.

The names here are imported when they are used: recordings and the wire format need no server.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from turbopi.serve.calls import Policy
    from turbopi.serve.launch import run, running
    from turbopi.serve.options import ServerOptions
    from turbopi.serve.server import PolicyServer

__all__ = ["Policy", "PolicyServer", "ServerOptions", "run", "running"]

_MODULES = {
    "run": "launch",
    "Policy": "calls",
    "PolicyServer": "server",
    "ServerOptions": "options",
    "running": "launch",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
