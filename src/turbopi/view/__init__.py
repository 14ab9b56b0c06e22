"""Recordings and live servers in the rerun viewer (the extra `view`): `turbopi view`.

calls.py     one call, wherever it comes from
recorded.py  the calls of a recording
live.py      the calls of a server's page
drawing.py   calls as rerun's entities
viewer.py    opening the viewer
"""

from importlib.util import find_spec

from turbopi.support.installation import install_command


def unavailable() -> str | None:
    """Why nothing can be viewed and what to do, None if it can."""
    if find_spec("rerun") is None:
        return f"rerun isn't installed; install it with: {install_command('view')}"
    return None
