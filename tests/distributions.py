"""What pip leaves of a distribution for entry points: a .dist-info folder, made of a pyproject.toml's text."""

import re
from pathlib import Path


def install(folder: Path, pyproject: str) -> None:
    """Write the .dist-info of what `pyproject` describes into `folder`, which belongs on sys.path."""
    about = dict(re.findall(r'^(name|version|description) = "(.*)"$', pyproject, re.MULTILINE))
    info = folder / f"{about['name'].replace('-', '_')}-{about['version']}.dist-info"
    info.mkdir(parents=True)
    lines = ("Metadata-Version: 2.1", *(f"{key}: {about.get(key.lower(), '')}" for key in ("Name", "Version")))
    text = "\n".join((*lines, f"Summary: {about.get('description', '')}"))
    (info / "METADATA").write_text(text + "\n", encoding="utf-8")
    points = ""
    for group, table in re.findall(r'^\[project\.entry-points\."([\w.]+)"\]\n((?:\w.*\n?)*)', pyproject, re.MULTILINE):
        points += f"[{group}]\n" + table.replace('"', "")
    (info / "entry_points.txt").write_text(points, encoding="utf-8")
