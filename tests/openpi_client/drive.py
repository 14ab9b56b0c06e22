"""Drives a policy server with the real openpi-client. Runs in an environment of its own: openpi-client needs numpy < 2.

drive.py PORT API_KEY     prints one JSON object of what the client saw
"""

import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import websockets.exceptions
from openpi_client.action_chunk_broker import ActionChunkBroker  # type: ignore[import-not-found]
from openpi_client.websocket_client_policy import WebsocketClientPolicy  # type: ignore[import-not-found]


def observation(prompt: str) -> dict[str, Any]:
    return {
        "observation/image": np.arange(2 * 2 * 3, dtype=np.uint8).reshape(2, 2, 3),
        "observation/state": np.linspace(-1, 1, 8),
        "observation/gripper_position": np.float32(0.25),
        "observation/step": np.int64(-7),
        "nested": {"images": {"cam_high": np.zeros((3, 2, 2), np.uint8)}},
        "prompt": prompt,
    }


def connect(port: int, key: str | None) -> Any:
    return WebsocketClientPolicy(host="127.0.0.1", port=port, api_key=key)


def error_of(function: Callable[..., Any], *arguments: Any) -> list[str] | None:
    try:
        function(*arguments)
    except Exception as error:
        return [type(error).__name__, str(error)]
    return None


def summary(result: dict[str, Any]) -> dict[str, Any]:
    actions = result["actions"]
    return {
        "keys": sorted(result),
        "prompt": result["prompt"],
        "actions": actions.tolist(),
        "dtype": str(actions.dtype),
        "server_timing": sorted(result["server_timing"]),
        "infer_ms": result["server_timing"]["infer_ms"],
    }


def drive(port: int, key: str) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    client = connect(port, key)
    seen["metadata"] = client.get_server_metadata()
    seen["first"] = summary(client.infer(observation("pick up the block")))
    seen["second"] = summary(client.infer(observation(np.str_("as a numpy string"))))

    nan = observation("nan")
    nan["observation/state"] = np.full(8, np.nan)
    seen["nan"] = error_of(client.infer, nan)
    seen["missing"] = error_of(client.infer, {"prompt": "x"})
    client._ws.send(b"not msgpack")
    seen["not msgpack"] = client._ws.recv()
    seen["after errors"] = summary(client.infer(observation("still here")))

    other = connect(port, key)
    seen["other"] = summary(other.infer(observation("second client")))
    seen["crash"] = error_of(other.infer, observation("crash"))
    seen["after crash"] = error_of(other.infer, observation("closed"))
    seen["reconnected"] = summary(connect(port, key).infer(observation("reconnected")))

    large = connect(port, key)
    big = observation("large")
    big["observation/image"] = np.zeros((2048, 1024, 3), np.uint8)
    seen["large"] = error_of(large.infer, big)

    broker = ActionChunkBroker(client, action_horizon=2)
    seen["broker"] = [broker.infer(observation(f"step {i}"))["actions"].tolist() for i in range(3)]

    for name, wrong in (("wrong key", "wrong"), ("no key", None)):
        try:
            connect(port, wrong)
        except websockets.exceptions.InvalidStatus as error:
            seen[name] = error.response.status_code
    return seen


if __name__ == "__main__":
    print(json.dumps(drive(int(sys.argv[1]), sys.argv[2])))
