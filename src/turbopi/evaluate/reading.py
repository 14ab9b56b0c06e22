"""Reading results.json: every value is checked, as the file may be damaged or come from elsewhere."""

from pathlib import Path

from turbopi.evaluate.results import FILE, FORMAT, Results, RunDocument
from turbopi.support.errors import ConfigError
from turbopi.support.reading import Fields, as_document, read_json

MAX_BYTES = 512 * 2**20  # of a run of 4,500 episodes: about 30 MB


def load_results(folder: Path) -> Results:
    """The run in a folder, or of a results.json. Raises ConfigError, naming file and key, if it can't be read."""
    path = folder / FILE if folder.is_dir() else folder
    if not path.exists():
        raise ConfigError(f"{folder} holds no {FILE}: it isn't the folder of an evaluation")
    content = read_json(path, ConfigError, limit=MAX_BYTES)
    if content.get("format") != FORMAT:
        raise ConfigError(
            f"{path} isn't a result of this version's `turbopi eval` (format {FORMAT}); name another folder"
        )
    run = as_document(content, RunDocument, path, ConfigError)
    Fields(run.protocol, f"{path}: protocol", ConfigError).text("suite")
    results = Results(path.parent, run.protocol, run.policy, run.tasks, run.versions, run.options)
    for place, episode in enumerate(run.episodes):
        where = f"{path}: episodes[{place}]"
        if episode.task not in results.tasks:
            known = ", ".join(map(str, results.tasks)) or "it has none"
            raise ConfigError(f"{where}.task is {episode.task}; expected the index of a task: {known}")
        if episode.key in results.episodes:
            raise ConfigError(
                f"{where}.initial_state is {episode.initial_state}; "
                f"expected another one: task {episode.task} has this one twice"
            )
        results.episodes[episode.key] = episode
    results.planned = set(run.planned)
    results.started, results.wall_seconds = run.started, run.wall_seconds
    return results


def check_is_run(folder: Path) -> None:
    """Raise ConfigError if a folder's results.json isn't an evaluation's, damaged or not: it would be lost."""
    path = folder / FILE
    if not path.exists():
        return
    try:
        content = read_json(path, ConfigError, limit=MAX_BYTES)
    except ConfigError:
        return  # what nobody can read is no loss
    if "episodes" not in content:
        raise ConfigError(f"{path} isn't the result of an evaluation, so it isn't replaced; give another --out")
