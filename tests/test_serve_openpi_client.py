"""The server as the real openpi-client sees it.

openpi-client needs numpy < 2, so it runs in an environment of its own: the interpreter that
TURBOPI_OPENPI_CLIENT_PYTHON names, or .venv-openpi-client in the repository. (It imports typing_extensions without
asking for it, so that is installed beside it.)
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serve_fakes import FakePolicy, PipelinedFakePolicy
from test_serve_real_time import Joins

from turbopi.serve import running

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[1]
PYTHON = Path(
    os.environ.get("TURBOPI_OPENPI_CLIENT_PYTHON", REPOSITORY / ".venv-openpi-client" / "bin" / "python")
).absolute()
API_KEY = "secret-123"


def openpi_client() -> Path:
    """The interpreter that has openpi-client; without it the test is skipped."""
    if not PYTHON.is_file():
        hint = (
            f"openpi-client isn't installed at {PYTHON}; to get it: "
            "python3 -m venv .venv-openpi-client && .venv-openpi-client/bin/pip install openpi-client typing_extensions"
        )
        if os.environ.get("TURBOPI_REQUIRE_OPENPI_CLIENT"):
            pytest.fail(hint)
        pytest.skip(hint)
    return PYTHON


@pytest.fixture(scope="module", params=[FakePolicy, PipelinedFakePolicy])
def seen(request: pytest.FixtureRequest) -> dict[str, Any]:
    """What openpi-client saw, in one session against one server."""
    python = openpi_client()
    policy: FakePolicy = request.param()
    with running(policy, api_key=API_KEY, max_message_mb=4) as server:
        client = subprocess.run(
            [python, Path(__file__).parent / "openpi_client" / "drive.py", str(server.port), API_KEY],
            capture_output=True,
            text=True,
            timeout=300,
        )
    assert client.returncode == 0, client.stderr
    return {**json.loads(client.stdout), "received": policy.observations["pick up the block"]}


STATE = np.linspace(-1, 1, 8)


def test_openpi_client_receives_the_metadata(seen: dict[str, Any]) -> None:
    assert seen["metadata"] == FakePolicy().metadata


def test_arrays_and_scalars_reach_the_policy_as_they_were(seen: dict[str, Any]) -> None:
    received = seen["received"]
    np.testing.assert_array_equal(received["observation/image"], np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    assert received["observation/image"].dtype == np.uint8
    np.testing.assert_array_equal(received["observation/state"], STATE)
    assert received["observation/gripper_position"] == np.float32(0.25)
    assert type(received["observation/gripper_position"]) is np.float32
    assert received["observation/step"] == -7
    assert type(received["observation/step"]) is np.int64
    assert received["nested"]["images"]["cam_high"].shape == (3, 2, 2)


@pytest.mark.parametrize(
    ("call", "prompt"),
    [
        ("first", "pick up the block"),
        ("second", "as a numpy string"),
        ("after errors", "still here"),
        ("other", "second client"),
        ("reconnected", "reconnected"),
    ],
)
def test_openpi_client_receives_actions_and_timings(seen: dict[str, Any], call: str, prompt: str) -> None:
    result = seen[call]
    assert result["keys"] == ["actions", "policy_timing", "prompt", "server_timing"]
    assert result["prompt"] == prompt
    assert result["dtype"] == "float64"
    np.testing.assert_array_equal(result["actions"], np.stack([STATE, STATE]))
    assert result["infer_ms"] > 0
    later = call in ("second", "after errors")
    assert result["server_timing"] == (["infer_ms", "prev_total_ms"] if later else ["infer_ms"])


@pytest.mark.parametrize(
    ("call", "text"),
    [
        ("nan", "bad observation: observation/state holds nan at [0]: every value must be finite"),
        ("missing", "bad observation: the key 'observation/state' is missing; this robot sends ['prompt']"),
    ],
)
def test_a_bad_observation_is_a_runtime_error_with_its_reason(seen: dict[str, Any], call: str, text: str) -> None:
    assert seen[call] == ["RuntimeError", f"Error in inference server:\n{text}"]


def test_bytes_that_are_no_message_get_a_reason(seen: dict[str, Any]) -> None:
    assert seen["not msgpack"] == "bad request: not a msgpack message: 10 bytes follow its end at byte 1"


def test_a_crash_is_a_runtime_error_with_the_traceback_and_ends_the_connection(seen: dict[str, Any]) -> None:
    name, text = seen["crash"]
    assert name == "RuntimeError"
    assert "Traceback (most recent call last):" in text
    assert "RuntimeError: CUDA error" in text
    name, text = seen["after crash"]
    assert name == "ConnectionClosedError"
    assert "1011" in text


def test_a_message_over_the_limit_says_so(seen: dict[str, Any]) -> None:
    name, text = seen["large"]
    assert name == "ConnectionClosedError"
    assert "1009" in text
    assert str(4 * 2**20) in text


def test_action_chunk_broker_plays_a_chunk_before_it_asks_again(seen: dict[str, Any]) -> None:
    np.testing.assert_array_equal(seen["broker"], np.stack([STATE] * 3))


@pytest.mark.parametrize("case", ["wrong key", "no key"])
def test_a_wrong_api_key_is_refused(seen: dict[str, Any], case: str) -> None:
    assert seen[case] == 401


def test_openpi_client_gets_joined_chunks_and_an_executor_without_pytorch() -> None:
    python = openpi_client()
    policy = Joins()
    drive = Path(__file__).parent / "openpi_client" / "drive_real_time.py"
    with running(policy, execution="rtc", control_hz=100) as server:
        command = [str(python), str(drive), str(server.port), str(REPOSITORY / "src")]
        client = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert client.returncode == 0, client.stderr
    seen = json.loads(client.stdout)
    assert [answer["joined"] for answer in seen["answers"]] == [False, True]
    assert (seen["answers"][1]["row"], seen["answers"][1]["row_by"], seen["answers"][1]["delay"]) == (3, "step", 1)
    assert "turbopi/step is 1, after 3" in seen["refused"]
    assert seen["places"] == [float(i) for i in range(30)]
    assert seen["torch"] is False
    reported = [previous for previous in policy.calls[5:] if previous is not None]
    assert reported and all(previous.mode == "rtc" for previous in reported)
