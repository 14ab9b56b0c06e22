"""`turbopi serve`: as a process of its own, with a client."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import numpy as np
import pytest
from cli_helpers import refusal, turbopi
from websockets.sync.client import connect

from turbopi import backends
from turbopi.checkpoint import random_checkpoint
from turbopi.cli.capabilities import capabilities_of
from turbopi.cli.framework import Output
from turbopi.cli.options import PolicyOptions
from turbopi.cli.ports import why_not_free
from turbopi.models.observation import Observation
from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.shipped import load_frames
from turbopi.realtime.wire import pack, unpack
from turbopi.recordings import iter_recording
from turbopi.serve import running
from turbopi.support.errors import ConfigError

TINY = ("--random-weights", "pi05_tiny", "--steps", "2")


@contextmanager
def serving(*options: str, **environment: str) -> Iterator[tuple["subprocess.Popen[str]", str, list[str]]]:
    """A server process: itself, its URL, and what it has printed."""
    command = [sys.executable, "-m", "turbopi.cli", "serve", *TINY, "--port", "0", *options]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
    ) as process:
        try:
            printed: list[str] = []
            yield process, wait_for_url(process, printed), printed
        finally:
            if process.poll() is None:
                process.kill()


def wait_for_url(process: "subprocess.Popen[str]", printed: list[str]) -> str:
    assert process.stdout is not None and process.stderr is not None
    too_late = threading.Timer(120, process.kill)  # select() wouldn't see a line that readline() has read ahead
    too_late.start()
    try:
        for line in process.stdout:
            printed.append(line)
            if found := re.search(r"Serving at (ws://\S+)", line):
                return found[1]
    finally:
        too_late.cancel()
    raise AssertionError(f"the server ended, or didn't serve in 120 s: {printed} {process.stderr.read()}")


@pytest.mark.slow
def test_a_client_gets_actions_and_ctrl_c_stops(tmp_path: Path) -> None:
    frame = load_frames()[0]
    observation: dict[str, Any] = {
        "observation/image": frame.base,
        "observation/wrist_image": frame.wrist,
        "observation/state": frame.state,
    }  # no prompt: the default
    options = ("--default-prompt", "open the drawer", "--record", str(tmp_path))
    with serving(*options, TURBOPI_API_KEY="k3y") as (process, url, printed):
        assert printed[0] == "RANDOM WEIGHTS (pi05_tiny, seed 0): the actions mean nothing.\n"
        assert "Warming up …\n" in printed
        assert any(re.fullmatch(r"warm-up: \d+\.\d s\n", line) for line in printed)
        with connect(url, additional_headers={"Authorization": "Api-Key k3y"}, compression=None) as client:
            metadata = unpack(client.recv(decode=False))
            assert metadata["default_prompt"] == "open the drawer"
            assert metadata["random_weights"] is True
            client.send(pack(observation))
            result = unpack(client.recv(decode=False))
            assert result["actions"].shape == (10, 7)
            assert np.isfinite(result["actions"]).all()
        http = url.replace("ws://", "http://")
        assert urlopen(f"{http}/healthz", timeout=120).read() == b"OK\n"
        metrics = urlopen(Request(f"{http}/metrics", headers={"Authorization": "Api-Key k3y"}), timeout=120)
        assert b"turbopi_requests_total 1.0" in metrics.read()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert out.endswith("Stopped.\n")
    assert "Traceback" not in err
    ((seen, actions),) = iter_recording(tmp_path)
    np.testing.assert_array_equal(seen["observation/image"], frame.base)
    np.testing.assert_array_equal(actions, result["actions"])
    (manifest,) = tmp_path.glob("*/manifest.json")
    assert json.loads(manifest.read_text())["metadata"]["config"] == "pi05_tiny"


def test_no_warmup_hides_the_policys_warmup_from_the_server(monkeypatch: Any) -> None:
    served: dict[str, Any] = {}
    monkeypatch.setattr(
        "turbopi.serve.run", lambda policy, options, **_: served.update(policy=policy, **asdict(options))
    )
    requested = ["--queue-limit", 3, "--max-message-mb", 1.5, "--max-batch", 1, "--deadline-ms", 200]
    result = turbopi("serve", *TINY, "--port", 0, "--no-warmup", *requested)
    assert result.exit_code == 0, result.output
    assert not hasattr(served["policy"], "warmup")
    assert served["policy"].metadata["num_denoising_steps"] == 2
    assert (served["queue_limit"], served["max_message_mb"]) == (3, 1.5)
    assert (served["max_batch"], served["deadline_ms"]) == (1, 200.0)
    assert (served["host"], served["port"], served["api_key"], served["record_dir"]) == ("127.0.0.1", 0, None, None)


def test_what_a_server_is_to_join_reaches_it(monkeypatch: Any) -> None:
    served: dict[str, Any] = {}
    monkeypatch.setattr(
        "turbopi.serve.run", lambda policy, options, **_: served.update(policy=policy, **asdict(options))
    )
    requested = ["--execution", "rtc_identity", "--control-hz", 50, "--execution-horizon", 6, "--delay-steps", 2]
    result = turbopi("serve", *TINY, "--port", 0, "--no-warmup", *requested)
    assert result.exit_code == 0, result.output
    names = ("execution", "control_hz", "execution_horizon", "delay_steps")
    assert [served[name] for name in names] == ["rtc_identity", 50.0, 6, 2]
    policy = served["policy"]
    answer = policy.infer(policy._policy.example_observation(), previous=None, model_actions=True)
    assert "model_actions" in answer


RTC = ["--execution", "rtc", "--control-hz", "50"]
CANNOT = "was asked for, which this policy can't: it offers"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--execution", "rtc_trained", "--control-hz", "50"],
            f"--execution rtc_trained {CANNOT} ['rtc', 'rtc_identity', 'warm_start', 'paint']. That mode is for check",
        ),
        ([*RTC, "--solver", "heun", "--steps", "6"], f"--execution rtc {CANNOT} ['warm_start']"),
        (
            [*RTC, "--max-batch", "4", "--backend", "pytorch"],
            "--max-batch 4 was asked for, but this policy runs requests",
        ),
        (
            [*RTC, "--execution-horizon", "11"],
            "--execution-horizon 11 was asked for, but this policy's chunks have 10 ",
        ),
        (
            [*RTC, "--delay-steps", "3", "--execution-horizon", "8"],
            "--delay-steps 3 was asked for, but with chunks of 10 actions and an execution horizon of 8 at most 2 "
            "control steps fit: give at most that, another --execution-horizon, or a lower control rate",
        ),
    ],
)
def test_what_the_policy_cannot_do_is_refused_before_its_weights_are_loaded(
    options: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(PolicyOptions, "make_policy")
    assert message in refusal(turbopi("serve", *TINY, "--device", "cpu", "--port", 0, *options))


@pytest.mark.parametrize("settings", [{}, {"real_time": {"trained_max_delay": 2}}, {"solver": "heun"}], ids=repr)
@pytest.mark.parametrize("backend", ["auto", "pytorch"])
def test_what_a_policy_offers_is_known_before_its_weights_are_loaded(
    settings: dict[str, Any], backend: str, tmp_path: Path
) -> None:
    config = tmp_path / "mine.json"
    config.write_text(json.dumps({"preset": "pi05_tiny", **settings}))
    options = PolicyOptions(random_weights="pi05_tiny", config=str(config), backend=backend, device="cpu")
    offered, policy = capabilities_of(options, options.open(None)), options.make_policy(options.open(None), Output())
    assert offered.real_time == policy.metadata["real_time"]
    assert (offered.pipelined, offered.batch_modes) == (policy.pipelined, policy.batch_modes)
    assert ("rtc_trained" in offered.real_time["modes"]) == ("real_time" in settings)


def test_what_backends_for_gpus_offer_is_known_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "check", lambda *_, **__: None)
    found = {
        name: capabilities_of(options, options.open(None))
        for name in ("fused", "cuda_graph", "tensorrt", "tensorrt_pipelined")
        if (options := PolicyOptions(random_weights="pi05_tiny", backend=name, device="cpu"))
    }
    modes = ("rtc", "rtc_identity", "warm_start")
    assert {name: one.batch_modes for name, one in found.items() if one.batch_modes} == {
        "fused": modes,
        "cuda_graph": modes,
    }
    assert [name for name, one in found.items() if one.pipelined] == ["tensorrt_pipelined"]
    assert [name for name, one in found.items() if one.real_time["modes"]] == ["fused", "cuda_graph"]
    heun = PolicyOptions(random_weights="pi05_tiny", backend="tensorrt", device="cpu", solver="heun")
    with pytest.raises(ConfigError, match="takes Euler's steps on the uniform grid alone"):
        capabilities_of(heun, heun.open(None))


def test_strict_reaches_the_policy_and_needs_a_warm_up(monkeypatch: Any) -> None:
    served: dict[str, Any] = {}
    monkeypatch.setattr("turbopi.serve.run", lambda policy, options, **_: served.update(policy=policy))
    assert turbopi("serve", *TINY, "--port", 0, "--strict").exit_code == 0
    assert served["policy"].metadata["strict"] is True
    assert "with --no-warmup that would be everything" in refusal(turbopi("serve", *TINY, "--strict", "--no-warmup"))


def test_a_port_is_ready_once_every_number_of_cameras_is_warm(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), device="cpu", robot="plain", num_denoising_steps=1)
    warm: list[int] = []

    def warmup(observation: Observation, *arguments: Any, **options: Any) -> None:
        warm.append(int(observation.image_mask.sum()))

    monkeypatch.setattr(policy.backend, "warmup", warmup)
    with running(policy):
        assert sorted(warm) == [1, 2, 3]


@pytest.mark.slow
def test_ctrl_c_while_it_warms_up_stops_it_before_any_client() -> None:
    command = [sys.executable, "-m", "turbopi.cli", "serve", *TINY[:2], "--steps", "100", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            while "Warming up" not in (line := process.stdout.readline()):
                assert line
            time.sleep(0.5)  # it is said just before it begins
            process.send_signal(signal.SIGINT)
            rest, errors = process.communicate(timeout=250)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    assert "Stopping" in rest and "Serving at" not in rest and "Traceback" not in errors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--api-key", "a b"], "the API key must be printable ASCII without spaces"),
        (["--max-message-mb", "0"], "--max-message-mb 0 should be more than 0 and finite"),
        (["--record", __file__], "is a file"),
        (["--execution", "async", "--control-hz", "50"], "--execution async isn't a server's: it joins chunks by rtc"),
        (["--execution", "rtc"], "--execution rtc needs the robots' control rate, too: give --control-hz"),
        (["--control-hz", "0"], "--control-hz 0 should be more than 0"),
        (["--deadline-ms", "0"], "--deadline-ms 0 should be more than 0 and at most 60000"),
        (["--allowed-hosts", "http://robot.lab"], "--allowed-hosts has 'http://robot.lab', which is no name"),
        (["--max-batch", "4", "--no-warmup"], "--max-batch 4 needs the warm-up, which measures batches"),
    ],
)
def test_bad_options_are_refused_before_weights_are_loaded(options: list[str], message: str) -> None:
    assert message in refusal(turbopi("serve", *TINY, *options))


def test_an_empty_key_in_the_environment_lets_nobody_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TURBOPI_API_KEY", "")
    assert "TURBOPI_API_KEY is empty" in refusal(turbopi("serve", *TINY))


def test_a_taken_port_is_refused_before_weights_are_loaded() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        message = refusal(turbopi("serve", *TINY, "--port", port))
    assert message.startswith(f"can't listen on 127.0.0.1:{port}: ")
    assert message.endswith("Choose another --host or --port")


def test_a_port_that_is_taken_on_one_address_of_several_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def both(*_: Any, **__: Any) -> list[Any]:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in ("127.0.0.2", "127.0.0.1")]

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setattr(socket, "getaddrinfo", both)
        assert why_not_free("two", port) == "Address already in use"
    assert why_not_free("two", port) is None


def test_a_host_that_is_not_this_machine_is_refused() -> None:
    assert "can't listen on 192.0.2.1:8000: " in refusal(turbopi("serve", *TINY, "--host", "192.0.2.1"))


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--max-message-mb", "0", "--max-message-mb 0 should be more than 0"),
        ("--api-key", "two words", "the API key must be printable ASCII without spaces"),
    ],
)
def test_what_the_server_refuses_is_one_line(option: str, value: str, expected: str) -> None:
    result = turbopi("serve", *TINY, "--port", 0, option, value)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {expected}")
