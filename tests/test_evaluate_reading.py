"""results.json may be damaged or come from elsewhere: it is read, or refused in one line that names file and key."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from turbopi.evaluate.compare import cells, compare, document
from turbopi.evaluate.reading import load_results
from turbopi.evaluate.report import write_report
from turbopi.evaluate.results import Episode, PolicyDescription, Results
from turbopi.sim import Task
from turbopi.support.errors import ConfigError
from turbopi.support.reading import plain_document


def good(folder: Path) -> dict[str, Any]:
    """A document as a run writes it."""
    policy = PolicyDescription("a policy", {"weights": "abc", "precision": "f32"}, {"robot": "libero"})
    tasks = [Task(0, "red", "reach the red dot", 50, 80)]
    results = Results(folder, {"suite": "colors", "sim": {"seed": 7}}, policy, tasks, {"torch": "2"}, {"workers": 1})
    for state, status in enumerate(("success", "failure", "aborted", "crash")):
        about: Any = (0, state, status, 10, 2**32 - 1, 1.5, [3.0], [2.0], [1], "said", "videos/a.mp4")
        episode = Episode(*about)
        results.episodes[episode.key] = episode
    results.planned = set(results.episodes)
    return json.loads(json.dumps(results.as_json()))


def write(folder: Path, content: Any) -> Path:
    file = folder / "results.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return file


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    before = good(tmp_path)
    write(tmp_path, before)
    after = json.loads(json.dumps(load_results(tmp_path).as_json()))
    assert {**after, "updated": None} == {**before, "updated": None}
    assert load_results(tmp_path / "results.json").folder == tmp_path


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"format": 99}, r"isn't a result of this version's `turbopi eval` \(format 1\)"),
        ({"protocol": None}, "protocol is None; expected an object"),
        ({"protocol": {"suite": 3}}, "protocol: suite is 3; expected a text"),
        ({"policy": []}, r"policy is \[\]; expected an object"),
        ({"policy": {"identity": "x"}}, "policy.identity is 'x'; expected an object"),
        ({"tasks": {}}, "tasks is {}; expected a list"),
        ({"tasks": [7]}, r"tasks\[0\] is 7; expected an object"),
        ({"episodes": [[]]}, r"episodes\[0\] is \[\]; expected an object"),
        ({"planned": [[0]]}, r"planned\[0\] is \[0\]; expected a task and an initial state"),
        ({"started": 5}, "started is 5; expected a text"),
        ({"wall_seconds": "long"}, "wall_seconds is 'long'; expected a finite number"),
    ],
)
def test_wrong_values_are_refused_by_key(change: dict[str, Any], why: str, tmp_path: Path) -> None:
    file = write(tmp_path, good(tmp_path) | change)
    with pytest.raises(ConfigError, match=why) as reported:
        load_results(tmp_path)
    assert str(reported.value).startswith(str(file))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"status": "won"}, r"episodes\[1\]\.status is 'won'; expected one of success, failure, aborted, crash"),
        ({"status": ["success"]}, r"status is \['success'\]"),
        ({"steps": -1}, "steps is -1; expected a whole number from 0"),
        ({"steps": 10**18}, "steps is 1000000000000000000"),
        ({"steps": True}, "steps is True"),
        ({"call_ms": [1, "2"]}, r"episodes\[1\]\.call_ms\[1\] is '2'; expected a finite number from 0 to 1e\+12"),
        ({"call_ms": [1e300]}, r"call_ms\[0\] is 1e\+300; expected a finite number from 0 to 1e\+12"),
        ({"batch": [0]}, r"batch\[0\] is 0; expected a whole number from 1 to 1000000000"),
        ({"task": 5}, "task is 5; expected the index of a task: 0"),
        ({"initial_state": 0}, "initial_state is 0; expected another one: task 0 has this one twice"),
        ({"video": 3}, "video is 3; expected a text or null"),
    ],
)
def test_a_wrong_episode_is_refused_by_its_place(change: dict[str, Any], why: str, tmp_path: Path) -> None:
    content = good(tmp_path)
    content["episodes"][1] |= change
    write(tmp_path, content)
    with pytest.raises(ConfigError, match=why):
        load_results(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"format": 1}', "[" * 100_000, '{"format": NaN}', "\0", "\ud800"]
)
def test_what_is_no_result_is_refused_by_file(text: str, tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ConfigError, match=f"^{file}"):
        load_results(tmp_path)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every value in a document."""
    yield path
    for key, item in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from places(item, (*path, key))


def changed(content: Any, path: tuple[Any, ...], new: Any) -> Any:
    """A copy with another value at a place; with `...` instead of one, without it."""
    content = copy.deepcopy(content)
    inside = content
    for key in path[:-1]:
        inside = inside[key]
    if new is ...:
        del inside[path[-1]]
    else:
        inside[path[-1]] = new
    return content


WRONG: tuple[Any, ...] = (
    ...,
    None,
    True,
    -1,
    0,
    10**18,
    1.5,
    1e308,
    "",
    "text",
    [],
    [None],
    [[]],
    {},
    {"x": None},
    {"fp8": "y"},
)


@pytest.mark.slow
def test_any_wrong_value_at_any_place_is_refused_or_harms_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is accepted can be shown, compared and continued."""
    monkeypatch.setattr("turbopi.evaluate.report.write_plots", lambda results: [])
    content = good(tmp_path)
    content["policy"]["about"]["backend_details"] = {"fp8": {"observations": "random-noise", "identity": "abc"}}
    write(tmp_path, content)
    first, said, accepted = load_results(tmp_path), list[str](), 0
    for path in list(places(content))[1:]:
        for new in WRONG:
            write(tmp_path, changed(content, path, new))
            try:
                found = load_results(tmp_path)
                compared = compare([first, found])
                first.continue_from(found)
            except ConfigError as error:
                said.append(str(error))
                continue
            accepted += 1
            assert json.dumps(plain_document(document(compared)), allow_nan=False) and [cells(one) for one in compared]
            write_report(found)
    assert len(said) > 300 and accepted > 300
    assert all(str(tmp_path) in line and "\n" not in line for line in said)
