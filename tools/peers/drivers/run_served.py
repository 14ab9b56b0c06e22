"""SGLang's and vLLM-Omni's Pi0.5: their own server on this machine, over its websocket for openpi's clients.

Both load a checkpoint only, in LeRobot's layout: the job's. Its chunk and its cameras have to be the job's.
"""

import atexit
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from peers.drivers.rounds import Built, clocked, random_images, serve
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

PROMPT = "pick up the red bowl and place it on the plate in the left drawer of the white cabinet"


def command(program: str, checkpoint: str, port: int) -> tuple[list[str], str]:
    """The server's words, and its websocket's path."""
    scripts = Path(sys.executable).parent
    if program == "sglang":
        words = ["serve", checkpoint, "--model-type", "diffusion", "--pipeline-class-name", "Pi05Pipeline"]
        return [str(scripts / "sglang"), *words, "--host", "127.0.0.1", "--port", str(port)], "/openpi/policy"
    import vllm_omni

    deploy = Path(vllm_omni.__file__).parent / "deploy" / "pi05.yaml"
    words = ["serve", checkpoint, "--omni", "--host", "127.0.0.1", "--port", str(port), "--deploy-config", str(deploy)]
    return [str(scripts / "vllm"), *words, "--disable-log-stats"], "/v1/realtime/robot/openpi"


def packed(value: Any) -> Any:
    """openpi's form of arrays in msgpack."""
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    return value


def unpacked(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value or "__ndarray__" in value:
        text = {key.decode() if isinstance(key, bytes) else key: content for key, content in value.items()}
        return np.ndarray(buffer=text["data"], dtype=text["dtype"], shape=text["shape"])
    return value


def build(job: dict[str, Any]) -> Built:
    described = json.loads((Path(job["checkpoint"]) / "config.json").read_text())
    inputs = described["input_features"]
    cameras = [name.removeprefix("observation.images.") for name in inputs if inputs[name]["type"] == "VISUAL"]
    cameras = [name for name in cameras if not name.startswith("empty_camera")]
    if len(cameras) < job["cameras"]:
        raise ValueError(f"the checkpoint has {len(cameras)} cameras; the job has {job['cameras']}")
    cameras = cameras[: job["cameras"]]
    state = np.zeros(inputs["observation.state"]["shape"], np.float32)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    words, path = command(job["program"], job["checkpoint"], port)
    server = subprocess.Popen(words, stdin=subprocess.DEVNULL)  # in this process's group, which the tool ends
    atexit.register(server.terminate)
    while True:
        if server.poll() is not None:
            raise RuntimeError(f"{words[0]} ended with {server.returncode} before it served")
        try:
            link = connect(f"ws://127.0.0.1:{port}{path}", max_size=None, compression=None)
            break
        except (OSError, WebSocketException):
            time.sleep(1.0)
    link.recv()  # its metadata
    images = random_images(job)

    def observation() -> dict[str, Any]:
        seen = dict(zip(cameras, images(), strict=True))
        named = {f"observation.images.{name}": image for name, image in seen.items()}
        if job["program"] == "sglang":
            return {**named, "observation.state": state, "task": PROMPT, "num_inference_steps": job["steps"]}
        sampling = {"num_inference_steps": job["steps"]}
        return {"images": named, "state": state, "prompt": PROMPT, "sampling_params": sampling}

    def whole() -> Any:
        link.send(msgpack.packb(observation(), default=packed))
        answer = link.recv()
        if isinstance(answer, str):
            raise RuntimeError(f"the server refused: {answer[:300]}")
        found = msgpack.unpackb(answer, object_hook=unpacked, strict_map_key=False)
        return np.asarray(found["actions"], np.float32)

    note = "over a websocket of this machine; the server tokenises and resizes; prompts are padded to 200 tokens"
    return Built({"whole call": clocked(whole)}, note, (job["program"], "vllm", "transformers", "torch"))


if __name__ == "__main__":
    serve(build)
