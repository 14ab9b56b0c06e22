"""Turbo-Pi's version."""

from importlib.metadata import PackageNotFoundError, version


def turbopi_version() -> str:
    """The installed version, or "from source" where Turbo-Pi runs without having been installed."""
    try:
        return version("turbopi")
    except PackageNotFoundError:
        return "from source"
