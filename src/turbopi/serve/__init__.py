"""Serving a policy over openpi's websocket protocol: `serve.run(policy)`, or PolicyServer inside an event loop."""

from turbopi.serve.launch import run
from turbopi.serve.server import Policy, PolicyServer, running

__all__ = ["Policy", "PolicyServer", "run", "running"]
