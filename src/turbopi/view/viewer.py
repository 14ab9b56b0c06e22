"""Opening the viewer, for this machine alone: rerun's own way to open one lets the whole network connect to it."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

from turbopi.support.errors import ConfigError

COMMAND = (sys.executable, "-m", "rerun_cli", "--bind=127.0.0.1", "--expect-data-soon")
SECONDS = 60.0  # until it listens


class Viewer(NamedTuple):
    """A viewer that outlives this process, and the address that recordings are sent to."""

    address: str
    process: "subprocess.Popen[bytes]"


def open_viewer(command: Sequence[str] = COMMAND) -> Viewer:
    """Start a viewer.

    Raises ConfigError if it ends at once, as without a display, or doesn't listen within SECONDS.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"RERUN_APP_ONLY": "true"}  # no questions about usage data on the terminal
    viewer = subprocess.Popen(
        [*command, f"--port={port}"], stdin=subprocess.DEVNULL, env=environment, start_new_session=True
    )
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline:
        if viewer.poll() is not None:
            raise ConfigError(
                f"the viewer ended at once, with exit code {viewer.returncode}: it needs a screen. --save FILE.rrd "
                "writes a file for another machine's"
            )
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return Viewer(f"rerun+http://127.0.0.1:{port}/proxy", viewer)
        except OSError:
            time.sleep(0.1)
    viewer.kill()
    viewer.wait()
    raise ConfigError(f"the viewer didn't open within {SECONDS:g} s; --save FILE.rrd writes a file instead")
