"""How Turbo-Pi was installed, and so the command that adds an extra: no index of packages has it by its name yet."""

import json
import shlex
import shutil
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit


def install_command(extra: str = "") -> str:
    """What to type to install Turbo-Pi's `extra`, or, without one, what Turbo-Pi itself requires.

    From a clone "pip install -e 'CLONE[extra]'"; where a wheel was installed, of that wheel.
    """
    python = shutil.which("pip")
    ours = python is not None and Path(python).parent == Path(sys.executable).parent
    pip = "pip" if ours else f"{shlex.quote(sys.executable)} -m pip"
    return f"{pip} install {_requirement(f'[{extra}]' if extra else '')}"


def manual(page: str) -> str:
    """Where docs/PAGE.md is to be read: in the clone, or in the repository that a wheel names."""
    path = f"docs/{page}.md"
    if (_clone() / path).is_file():
        return path
    with suppress(metadata.PackageNotFoundError):
        about = metadata.metadata("turbopi")
        urls = dict(one.split(", ", 1) for one in about.get_all("Project-URL") or [])
        if "Repository" in urls:
            return f"{urls['Repository']}/blob/v{about['Version']}/{path}"
    return f"{path} of Turbo-Pi's documentation"


def _requirement(extra: str) -> str:
    if (_clone() / "pyproject.toml").is_file():
        return f"-e '{_clone()}{extra}'"
    origin = _origin()
    address = str(origin.get("url", ""))
    if "vcs_info" in origin:
        kind, commit = origin["vcs_info"]["vcs"], origin["vcs_info"]["commit_id"]
        return f"'turbopi{extra} @ {kind}+{address}@{commit}'"
    if address.startswith("file:"):
        return f"'{unquote(urlsplit(address).path)}{extra}'"
    return f"'turbopi{extra} @ {address}'" if address else f"'turbopi{extra}'"


def _clone() -> Path:
    """Where the clone would be."""
    return Path(__file__).resolve().parents[3]


def _origin() -> dict[str, Any]:
    """What pip noted of where Turbo-Pi came from (PEP 610); nothing if it came from an index by its name."""
    try:
        noted = metadata.distribution("turbopi").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return {}
    return {} if noted is None else dict(json.loads(noted))
