"""The load test: when requests are sent and what is counted, with a clock of the test's own; and small whole runs."""

import importlib
import io
import json
import threading
from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from load_test import marks, stand_in, timeline
from load_test.__main__ import main, show
from load_test.connections import connect, kind_of
from load_test.document import COLUMNS, Load, LoadDocument, Spread, read_load, summary
from load_test.observations import OF_A_CLIENT, image_size, observations, shapes
from load_test.run import Wanted, run
from load_test.schedule import ERROR_PAUSE, Clock, Refused, Request, closed_loop, due_times, open_loop
from load_test.timeline import WARM_UP, items
from rich.console import Console
from serve_fakes import FakePolicy
from test_serve_openpi_client import openpi_client

from turbopi.realtime.wire import pack
from turbopi.serve import running
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading import plain_document

# --- when requests are sent -------------------------------------------------------------------------------------------


class Time:
    """Passes when somebody sleeps."""

    def __init__(self) -> None:
        self.now = 0.0
        self.clock = Clock(lambda: self.now, self.sleep)

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


class Server:
    """Answers each request after the next of `seconds`; None is an error after half a second."""

    def __init__(self, time: Time, *seconds: float | None) -> None:
        self.time, self.seconds, self.sent = time, list(seconds), list[Any]()

    def infer(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        self.sent.append(observation["number"])
        took = self.seconds.pop(0)
        self.time.sleep(0.5 if took is None else took)
        if took is None:
            raise Refused("busy")
        return {"actions": [], "server_timing": {"infer_ms": took * 900}}


OBSERVATIONS = [{"number": 0}, {"number": 1}, {"number": 2}]


def test_a_closed_loop_sends_when_it_is_answered_and_pauses_after_an_error() -> None:
    time = Time()
    server = Server(time, 1.0, None, 2.0, 1.0)
    requests = list(closed_loop(server, OBSERVATIONS, 4.0, time.clock))
    begins = [0.0, 1.0, 1.5 + ERROR_PAUSE, 3.5 + ERROR_PAUSE]
    assert [(r.due, r.free, r.sent) for r in requests] == [(begin, begin, begin) for begin in begins]
    assert [r.ended for r in requests] == [1.0, 1.5, 3.5 + ERROR_PAUSE, 4.5 + ERROR_PAUSE]
    assert [r.error for r in requests] == [None, "busy", None, None]
    assert [r.infer_ms for r in requests] == [900, None, 1800, 900]
    assert server.sent == [0, 1, 2, 0]


def test_a_closed_loop_sends_one_request_at_least() -> None:
    time = Time()
    time.now = 9.0
    assert len(list(closed_loop(Server(time, 1.0), OBSERVATIONS, 4.0, time.clock))) == 1


def test_latency_in_an_open_loop_begins_when_a_request_is_due_not_when_it_could_be_sent() -> None:
    """One slow answer delays those behind it, and each of them counts its own wait."""
    time = Time()
    server = Server(time, 0.25, 3.0, 0.25, 0.25, 0.25)
    requests = list(open_loop(server, OBSERVATIONS, iter([0.0, 1.0, 2.0, 3.0, 5.0]), 9.0, time.clock))
    assert [r.sent for r in requests] == [0.0, 1.0, 4.0, 4.25, 5.0]
    assert [r.free for r in requests] == [0.0, 1.0, 4.0, 4.25, 5.0]
    assert [r.ended - r.due for r in requests if r.ended is not None] == [0.25, 3.0, 2.25, 1.5, 0.25]


def test_what_is_due_but_cannot_be_sent_before_the_end_is_noted_with_its_wait() -> None:
    time = Time()
    requests = list(open_loop(Server(time, 5.0), OBSERVATIONS, iter([0.0, 1.0, 2.0]), 4.0, time.clock))
    assert [(r.due, r.sent, r.ended, r.free) for r in requests[1:]] == [(1.0, None, None, 5.0), (2.0, None, None, 5.0)]
    fields = summary([requests], LOAD)
    assert (fields["requests"], fields["answered"], fields["unsent"]) == (3, 1, 2)
    spread = fields["latency_ms"]
    assert isinstance(spread, Spread) and (spread.min, spread.p50, spread.max) == (3000, 4000, 5000)


@pytest.mark.parametrize("clients", [1, 3, 7])
def test_a_fixed_rate_is_that_of_all_clients_together_at_equal_distances(clients: int) -> None:
    moments = sorted(m for i in range(clients) for m in due_times("fixed", 50, 10, i, clients, 0))
    np.testing.assert_allclose(moments, np.arange(500) / 50)


def test_poisson_arrivals_have_the_rate_the_spread_and_the_seed_that_is_asked_for() -> None:
    each = [list(due_times("poisson", 40, 500, i, 4, 7)) for i in range(4)]
    assert each == [list(due_times("poisson", 40, 500, i, 4, 7)) for i in range(4)]
    assert len({tuple(moments[:3]) for moments in each}) == 4
    assert each[0] != list(due_times("poisson", 40, 500, 0, 4, 8))
    moments = np.sort(np.concatenate(each))
    assert moments[0] > 0 and moments[-1] < 500
    assert abs(len(moments) - 20_000) < 5 * 20_000**0.5
    gaps = np.diff(moments)
    assert abs(gaps.std() / gaps.mean() - 1) < 0.05  # of equal distances: 0


# --- what is counted --------------------------------------------------------------------------------------------------

LOAD = Load(
    url="ws://x:1",
    client="turbopi",
    arrivals="fixed",
    clients=2,
    processes=1,
    rate=2.0,
    seconds=4.0,
    warmup_seconds=0.0,
    seed=0,
    robot="libero",
    camera_images=[(224, 224, 3)],
    message_bytes=1,
)


def test_only_what_is_due_after_the_warm_up_counts_and_each_error_by_its_kind() -> None:
    first = [
        Request(0.9, 0.9, 0.9, 1.8, 1.0, None),  # warm-up
        Request(1.0, 1.0, 1.5, 2.0, 300.0, None),
        Request(2.0, 2.0, 2.0, 2.5, None, "busy"),
        Request(3.0, 3.0, 3.0, 5.5, 500.0, None),  # answered after the end
    ]
    second = [Request(1.5, 1.5, 1.5, 2.0, None, "busy"), Request(2.0, 2.0, 2.0, 3.0, None, "bad actions")]
    load = replace_load(warmup_seconds=1.0)
    fields = summary([first, second], load)
    assert {key: fields[key] for key in ("requests", "answered", "errors", "unsent")} == {
        "requests": 5,
        "answered": 2,
        "errors": {"bad actions": 1, "busy": 2},
        "unsent": 0,
    }
    assert fields["answers_per_second"] == 1 / 4
    latency, infer, overhead = fields["latency_ms"], fields["infer_ms"], fields["overhead_ms"]
    assert isinstance(latency, Spread) and isinstance(infer, Spread) and isinstance(overhead, Spread)
    assert (latency.min, latency.max) == (1000, 2500)
    assert (infer.min, infer.max) == (300, 500)
    assert (overhead.min, overhead.mean, overhead.max) == (700, 1350, 2000)
    late = fields["sent_late_ms"]
    assert isinstance(late, Spread) and late.max == 500
    by_client: Any = fields["by_client"]
    assert [(one.answered, one.latency_ms) for one in by_client] == [(2, latency), (0, None)]


def replace_load(**changes: Any) -> Load:
    return Load(**{**{name: getattr(LOAD, name) for name in Load.__struct_fields__}, **changes})


def test_a_server_that_says_no_infer_ms_has_no_overhead() -> None:
    fields = summary([[Request(0.0, 0.0, 0.0, 1.0, None, None)]], LOAD)
    assert fields["answered"] == 1 and fields["infer_ms"] is None and fields["overhead_ms"] is None


def test_percentiles_are_those_of_all_requests() -> None:
    spread = Spread.of([float(i) for i in range(101)])
    assert spread == Spread(mean=50, min=0, p50=50, p90=90, p95=95, p99=99, max=100)
    assert Spread.of([]) is None


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("busy: 16 requests wait already (--queue-limit 16); try again", "busy"),
        ("bad observation: x", "bad observation"),
        ("bad request: x", "bad request"),
        ("the server is shutting down", "the server is shutting down"),
        ("the device is lost: CUDA error", "the device is lost"),
        ("Traceback (most recent call last):\n  ...", "traceback"),
        ("", "traceback"),
    ],
)
def test_a_text_frame_is_counted_by_its_beginning(text: str, kind: str) -> None:
    assert kind_of(text) == kind


# --- what is sent -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "expected"), [("libero", [(480, 640, 3)] * 2), ("droid", [(480, 640, 3)] * 2), ("aloha", [(3, 480, 640)])]
)
def test_pictures_have_the_size_that_is_asked_for_in_the_robots_layout(
    robot: str, expected: list[tuple[int, ...]]
) -> None:
    name, made = observations(robot, None, image_size("640x480"), 2, 0)
    assert name == robot and set(shapes(made[0][0])) == set(expected)
    assert len(made) == 2 and all(len(own) == OF_A_CLIENT for own in made)
    messages = [pack(one) for own in made for one in own]
    assert len(set(messages)) == 2 * OF_A_CLIENT  # no image is sent by two, or twice in turn
    again = observations(robot, None, image_size("640x480"), 2, 0)[1]
    assert [pack(one) for own in again for one in own] == messages


def test_a_recorded_observation_is_sent_with_new_pictures(tmp_path: Path) -> None:
    file = tmp_path / "observation.npz"
    arrays: Any = {"a/image": np.zeros((4, 6, 3), np.uint8), "state": np.arange(3.0), "prompt": np.array("lift")}
    np.savez(file, **arrays)
    _, made = observations(None, file, None, 1, 0)
    assert shapes(made[0][0]) == [(4, 6, 3)]
    assert list(made[0][0]["state"]) == [0, 1, 2] and str(made[0][0]["prompt"]) == "lift"


@pytest.mark.parametrize("text", ["640", "0x3", "ax3", "-3x3", "640x480x3", "10000x3", "²x3"])
def test_what_is_no_size_is_refused_by_name(text: str) -> None:
    with pytest.raises(ConfigError, match=f"--images {text}: expected"):
        image_size(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arrivals": "fixed"}, "an open loop needs a rate"),
        ({"rate": 3.0}, "an open loop needs a rate, and a closed loop has none"),
        ({"arrivals": "fixed", "rate": 0.0}, "the rate is 0 requests a second; expected more than 0"),
        ({"arrivals": "poisson", "rate": float("nan")}, "the rate is nan"),
        ({"clients": 0}, "--clients is 0; expected 1 to 1000"),
        ({"clients": 2, "processes": 3}, "--processes is 3; expected 1 to 2, the clients"),
        ({"seconds": 0.0}, "--seconds is 0; expected 0.1 to 86400"),
        ({"warmup": -1.0}, "--warmup is -1; expected 0 to 86400"),
        ({"url": "127.0.0.1:8000"}, r"127\.0\.0\.1:8000: expected ws://HOST:PORT"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_runs(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run(replace(Wanted(url="ws://127.0.0.1:9"), **changes), [])


# --- whole runs -------------------------------------------------------------------------------------------------------


class Counting(FakePolicy):
    """Counts, and refuses every `wrong`th observation."""

    def __init__(self, wrong: int = 0) -> None:
        super().__init__()
        self.calls, self.wrong, self._lock = 0, wrong, threading.Lock()
        self.camera_images: set[bytes] = set()

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        with self._lock:
            self.calls += 1
            self.camera_images.add(obs["observation/image"].tobytes())
            if self.wrong and self.calls % self.wrong == 0:
                raise ObservationError("another one")
        return super().infer(obs)


QUICK = {"seconds": 1.0, "warmup": 0.0, "drain_s": 100.0, "robot": "libero", "camera_images": (8, 6)}


def test_every_request_of_an_open_loop_is_sent_and_counted_once() -> None:
    policy = Counting(wrong=4)
    with running(policy) as server:
        wanted = Wanted(url=server.url, arrivals="fixed", rate=20.0, clients=3, processes=2, **QUICK)  # type: ignore[arg-type]
        document = run(wanted, ["python", "-m", "load_test"])
    assert policy.calls == document.requests == 20
    assert (document.answered, document.errors, document.unsent) == (15, {"bad observation": 5}, 0)
    assert sum(one.answered for one in document.by_client) == 15 and len(document.by_client) == 3
    assert len(document.clients.processes) == 2
    assert len(policy.camera_images) == 3 * OF_A_CLIENT
    latency, infer, overhead = document.latency_ms, document.infer_ms, document.overhead_ms
    assert latency is not None and infer is not None and overhead is not None
    assert latency.mean == pytest.approx(infer.mean + overhead.mean)
    assert infer.min > 0 and overhead.min > 0
    assert document.server["policy"] == "fake"
    assert document.load.camera_images == [(8, 6, 3)] * 2 and document.load.robot == "libero"


def test_a_closed_loop_counts_what_was_answered_and_its_document_comes_out_as_it_went_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, file, key = Counting(), tmp_path / "result.json", tmp_path / "key"
    key.write_text("secret-123\n")
    with running(policy, api_key="secret-123") as server:
        options = [server.url, "--robot", "libero", "--seconds", "0.5", "--warmup", "0", "--out", str(file)]
        assert main([*options, "--clients", "2", "--api-key-file", str(key)]) == 0
        shown = capsys.readouterr().out
        assert main(options) == 2  # without the key
        assert "wants its API key" in capsys.readouterr().err
    document = read_load(file)
    assert document.answered == document.requests == policy.calls >= 2
    assert document.errors == {} and document.sent_late_ms is None
    assert "secret-123" not in file.read_text()
    assert json.loads(file.read_text()) == json.loads(json.dumps(plain_document(document)))
    assert main(["--show", str(file)]) == 0
    assert capsys.readouterr().out == shown and "2 turbopi clients, closed loop" in shown


def test_the_robot_is_the_one_that_the_server_names() -> None:
    policy = Counting()
    reported = {"robot": "libero", "numbers": np.arange(2), "none": float("nan"), "tokenizer": "/home/ada/sp.model"}
    policy.metadata = {**policy.metadata, **reported}
    quick = {**QUICK, "robot": None}
    with running(policy) as server:
        document = run(Wanted(url=server.url, arrivals="fixed", rate=2.0, **quick), [])  # type: ignore[arg-type]
    assert document.load.robot == "libero" and document.answered == 2
    assert document.server["numbers"] == [0, 1] and document.server["none"] is None
    assert document.server["tokenizer"] == "sp.model"


def test_without_a_robot_or_a_server_it_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    with running(FakePolicy()) as server, pytest.raises(ConfigError, match="names no robot: say with --robot"):
        run(Wanted(url=server.url), [])
    assert main([server.url]) == 2
    assert "no policy server at ws://" in capsys.readouterr().err


def test_nothing_answered_is_exit_code_1(capsys: pytest.CaptureFixture[str]) -> None:
    with running(Counting(wrong=1)) as server:
        assert main([server.url, "--robot", "libero", "--seconds", "0.5", "--warmup", "0", "--rate", "4"]) == 1
        assert "0 of 2 requests answered" in capsys.readouterr().out
        assert main([server.url, "--robot", "libero", "--seconds", "0.1", "--warmup", "0.1", "--rate", "1"]) == 1
        assert "No request was due after the warm-up" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("prompt", "kind"),
    [
        ("nan actions", "bad actions"),
        ("crash", "traceback"),
        ("a lost", "the device is lost"),
    ],
)
def test_a_client_names_what_went_wrong_and_goes_on(prompt: str, kind: str) -> None:
    observation = {"observation/state": np.zeros(8), "prompt": prompt}
    with running(FakePolicy()) as server:
        connection = connect("turbopi", server.url, None, 60.0)
        with pytest.raises(Refused, match=kind):
            connection.infer(observation)
        if kind != "the device is lost":
            assert "actions" in connection.infer({**observation, "prompt": "well"})
        connection.close()
    with pytest.raises(Refused, match="connection lost"):
        connection.infer(observation)


def test_openpis_client_is_driven_in_its_own_environment() -> None:
    python, policy = openpi_client(), Counting(wrong=3)
    with running(policy, api_key="secret-123") as server:
        wanted = Wanted(url=server.url, arrivals="fixed", rate=9.0, client="openpi", api_key="secret-123", **QUICK)  # type: ignore[arg-type]
        document = run(replace(wanted, python=str(python)), [])
    assert (document.requests, document.answered, document.errors) == (9, 6, {"bad observation": 3})
    assert document.load.client == "openpi" and document.overhead_ms is not None
    assert len(policy.camera_images) == OF_A_CLIENT


def test_a_process_of_clients_that_fails_says_why() -> None:
    with running(Counting(), max_clients=2) as server, pytest.raises(ConfigError, match=r"clients ended: .*503"):
        run(Wanted(url=server.url, clients=3, **QUICK), [])  # type: ignore[arg-type]


# --- a server without a GPU -------------------------------------------------------------------------------------------


def test_the_stand_in_takes_a_gpus_time_for_one_and_for_several(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(stand_in.BACKENDS, "sleeping", stand_in.BACKENDS["pytorch"])  # all is as before after the test
    monkeypatch.setattr(stand_in.SleepingBackend, "gpu", "none")
    monkeypatch.setattr("torch.set_num_threads", lambda count: None)
    served: list[Any] = []
    stand_in.main(["--gpu", "h100_fp8"], run=lambda policy, port: served.append(policy))
    (policy,) = served
    observations = [policy.example_observation(seed) for seed in range(3)]
    results = policy.infer_batch(observations)
    assert [one["actions"].shape for one in results] == [policy.infer(observations[0])["actions"].shape] * 3
    least = sum(sum(policy.backend.stages[calls]) for calls in (2, 1))
    assert results[0]["policy_timing"]["infer_ms"] >= 0.99 * least
    assert not all(np.array_equal(one["actions"], results[0]["actions"]) for one in results), "each has its own noise"


# --- the table --------------------------------------------------------------------------------------------------------


def test_the_table_fits_80_columns_and_warns_of_what_would_mislead() -> None:
    spread = Spread(*(12345678.9,) * 7)
    policy = Counting()
    with running(policy) as server:
        document = run(Wanted(url=server.url, arrivals="fixed", rate=2.0, **QUICK), [])  # type: ignore[arg-type]
    names = LoadDocument.__struct_fields__
    fields: dict[str, Any] = {name: getattr(document, name) for name in names}
    fields |= dict.fromkeys(("latency_ms", "infer_ms", "overhead_ms", "sent_late_ms"), spread)
    fields |= {"unsent": 3, "errors": {"busy": 2}}
    fields["clients"] = type(document.clients)(
        processes=[type(document.clients.processes[0])(0.95, 10)], cpus=8, load_average=None
    )
    console = Console(file=io.StringIO(), width=COLUMNS)
    show(LoadDocument(**fields), console)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, shown.splitlines())) <= COLUMNS and shown.count("12345679") == 4 * 6
    assert "errors: 2 busy" in shown and "3 requests were never sent" in shown and "The clients were so busy" in shown


# --- timelines --------------------------------------------------------------------------------------------------------


def test_every_mark_is_of_a_function_that_there_is() -> None:
    for mark in marks.MARKS:
        module, _, name = mark.function.partition(":")
        assert callable(reduce(getattr, name.split("."), importlib.import_module(module))), mark


def test_an_item_is_what_passes_between_two_marks_of_a_call_whatever_else_was_noted() -> None:
    begin, end = [float(call) for call in range(WARM_UP + 2)], [call + 0.5 for call in range(WARM_UP + 2)]
    client = {"begin": begin, "end": end, "packed": [one + 0.01 for one in begin], "given": []}
    turns = [one + 0.02 for one in begin] + [0.001]
    server = {"turn": sorted(turns), "answered": [one + 0.4 for one in begin], "made": [one + 0.03 for one in begin]}
    found = [(item.name, round(item.p50), item.calls) for item in items(client, server)]
    assert [us for _, us, _ in found] == [10_000, 10_000, 10_000, 470_000]  # "answered" is behind "made": another's
    assert {calls for *_, calls in found} == {2}


@pytest.mark.slow  # two processes import what they need
def test_a_timeline_is_drawn_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "timeline.json"
    assert timeline.main(["--calls", "3", "--images", "64x48", "--out", str(file)]) == 0
    document = json.loads(file.read_text())
    names = [item["name"] for item in document["items"]]
    assert {"pack", "parse", "read, schedule", "unpack"} < set(names) and document["calls"] == 3
    assert document["beside_ms"]["p50"] <= document["latency_ms"]["p50"]
    shown = capsys.readouterr().out
    assert all(name in shown for name in names) and max(map(len, shown.splitlines())) <= COLUMNS
