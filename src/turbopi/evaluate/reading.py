"""Reading results.json: every value is checked, as the file may be damaged or come from elsewhere."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

from turbopi.errors import ConfigError
from turbopi.evaluate.results import FILE, FORMAT, STATUSES, Episode, Results, Status
from turbopi.reading import Fields, is_integer, read_json, shown
from turbopi.sim import Task

MAX_BYTES = 512 * 2**20  # of a run of 4,500 episodes: about 30 MB
_MAX_COUNT = 10**9
_MAX_SEED = 2**64 - 1
_MAX_TIME = 1e12  # a time in seconds or milliseconds


def load_results(folder: Path) -> Results:
    """The run in a folder, or of a results.json. Raises ConfigError, naming file and key, if it can't be read."""
    path = folder / FILE if folder.is_dir() else folder
    if not path.exists():
        raise ConfigError(f"{folder} holds no {FILE}: it isn't the folder of an evaluation")
    fields = Fields(read_json(path, ConfigError, limit=MAX_BYTES), path, ConfigError)
    if fields.values.get("format") != FORMAT:
        raise ConfigError(f"{path} isn't a result of this version's `turbopi eval` (format {FORMAT})")
    protocol, policy = fields.object("protocol"), fields.object("policy")
    protocol.text("suite")
    for name in ("identity", "about"):
        policy.object(name, {})
    tasks = [_task(one) for one in _objects(fields, "tasks")]
    versions, options = fields.object("versions").values, fields.object("options").values
    results = Results(path.parent, protocol.values, policy.values, tasks, versions, options)
    for one in _objects(fields, "episodes"):
        episode = _episode(one)
        if episode.task not in results.tasks:
            one.refuse("task", f"the index of a task: {', '.join(map(str, results.tasks)) or 'it has none'}")
        if episode.key in results.episodes:
            one.refuse("initial_state", f"another one: task {episode.task} has this one twice")
        results.episodes[episode.key] = episode
    results.planned = {_key(fields, place) for place in range(len(fields.list("planned")))}
    results.started, results.wall_seconds = fields.text("started"), fields.number("wall_seconds", 0, _MAX_TIME)
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


def _objects(fields: Fields, key: str) -> list[Fields]:
    """The objects of a list; messages name each by its place."""
    values = fields.list(key)
    for place, value in enumerate(values):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{fields.where}: {key}[{place}] is {shown(value)}; expected an object")
    return [Fields(value, f"{fields.where}: {key}[{place}]", ConfigError) for place, value in enumerate(values)]


def _task(one: Fields) -> Task:
    return Task(
        one.integer("index", 0, _MAX_COUNT),
        _text(one, "name"),
        _text(one, "instruction"),
        one.integer("num_initial_states", 0, _MAX_COUNT),
        one.integer("max_steps", 0, _MAX_COUNT),
    )


def _episode(one: Fields) -> Episode:
    return Episode(
        task=one.integer("task", 0, _MAX_COUNT),
        initial_state=one.integer("initial_state", 0, _MAX_COUNT),
        status=cast(Status, one.choice("status", STATUSES)),
        steps=one.integer("steps", 0, _MAX_COUNT),
        seed=one.integer("seed", 0, _MAX_SEED),
        seconds=one.number("seconds", 0, _MAX_TIME),
        call_ms=_times(one, "call_ms"),
        infer_ms=_times(one, "infer_ms"),
        batch=_counts(one, "batch"),
        message=_optional_text(one, "message"),
        video=_optional_text(one, "video"),
    )


def _times(one: Fields, key: str) -> list[float]:
    values = one.numbers(key)
    if not all(0 <= value <= _MAX_TIME for value in values):
        one.refuse(key, f"milliseconds from 0 to {_MAX_TIME:g}")
    return values


def _counts(one: Fields, key: str) -> list[int]:
    values = one.list(key)
    if not all(is_integer(value) and 1 <= value <= _MAX_COUNT for value in values):
        one.refuse(key, "a list of whole numbers from 1")
    return cast(list[int], values)


def _text(one: Fields, key: str) -> str:
    value = one.values.get(key)
    if not isinstance(value, str):
        one.refuse(key, "a text")
    return value


def _optional_text(one: Fields, key: str) -> str | None:
    return None if one.values.get(key) is None else _text(one, key)


def _key(fields: Fields, place: int) -> tuple[int, int]:
    value = fields.list("planned")[place]
    if not isinstance(value, list) or len(value) != 2 or not all(is_integer(one) and one >= 0 for one in value):
        raise ConfigError(f"{fields.where}: planned[{place}] is {shown(value)}; expected a task and an initial state")
    return value[0], value[1]
