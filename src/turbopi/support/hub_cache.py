"""Where the Hugging Face Hub's own libraries keep what they have fetched; nothing is fetched here."""

import os
import re
from pathlib import Path


def hub_folder(name: str) -> Path | None:
    """The newest snapshot of repository `name` ("owner/name") in the Hub's cache; None if it isn't there.

    The cache: $HF_HUB_CACHE, $HF_HOME/hub, or ~/.cache/huggingface/hub, as in huggingface_hub.
    """
    if not is_hub_name(name):
        return None
    repository = _cache() / f"models--{name.replace('/', '--')}"
    snapshots = repository / "snapshots"
    try:
        return snapshots / (repository / "refs/main").read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        there = [one for one in snapshots.iterdir() if one.is_dir()] if snapshots.is_dir() else []
        return max(there, key=lambda one: one.stat().st_mtime, default=None)


def is_hub_name(text: str) -> bool:
    """Whether it may be a repository's name, "owner/name", and is no path such as ../name."""
    return re.fullmatch(r"\w[\w.-]*/[\w.-]+", text) is not None


def _cache() -> Path:
    if own := os.environ.get("HF_HUB_CACHE"):
        return Path(own).expanduser()
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "huggingface"
    return Path(home).expanduser() / "hub"
