"""Which files below a path hold observations, and some of them, evenly spread."""

from pathlib import Path

from turbopi.recordings.format import recorded_files
from turbopi.support.errors import ObservationError


def observation_files(path: Path) -> list[Path]:
    """The observations of a recording, of a folder of them, or the one at `path`. Raises ObservationError for none."""
    if not path.exists():
        raise ObservationError(f"{path} doesn't exist")
    if path.is_dir():
        if (path / "observation.json").is_file():
            return [path]
        by_hand = sorted(file.parent for file in path.glob("*/observation.json"))
        return by_hand or recorded_files(path)
    return [path]


def chosen_files(path: Path, count: int | None = None) -> list[tuple[str, Path]]:
    """(name below `path`, file) of `count` observations there, evenly spread, or of all. Raises ObservationError."""
    files = observation_files(path)
    chosen = files if count is None else [files[i] for i in spread(len(files), count)]
    return [(file.name if file == path else str(file.relative_to(path)), file) for file in chosen]


def spread(available: int, count: int) -> list[int]:
    """`count` numbers below `available`, evenly spread; all if there are fewer."""
    return [i * available // count for i in range(count)] if available > count else list(range(available))
