"""Drives a server that joins chunks with the real openpi-client, then the executor with it, in its own environment.

drive_real_time.py PORT SOURCES   prints one JSON object; SOURCES is where `turbopi` lies, which isn't installed here
"""

import json
import sys
import time
from typing import Any

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy


def main(port: int, sources: str) -> None:
    sys.path.insert(0, sources)
    from turbopi.realtime import RealTimeExecutor

    client = WebsocketClientPolicy(host="127.0.0.1", port=port)
    requested: list[dict[str, Any]] = [{"turbopi/step": 0}, {"turbopi/step": np.int64(3), "turbopi/delay": np.int32(1)}]
    answers = [client.infer({"place": 0.0, **keys})["real_time"] for keys in requested]
    try:
        client.infer({"place": 0.0, "turbopi/step": 1})
        refused = None
    except RuntimeError as error:
        refused = str(error)
    places = []
    with RealTimeExecutor(
        client, control_hz=100, execution="async", max_observation_age_s=60, max_pause_s=60
    ) as executor:
        executor.warm_up({"place": 0.0})
        while len(places) < 30:
            executor.observe({"place": float(len(places))})
            command = executor.next_action()
            if command.kind == "fresh":
                places.append(float(command.action[0]))
            time.sleep(0.01)
        report = executor.report()
    seen = {"answers": answers, "refused": refused, "places": places, "dropped": report["dropped"]}
    print(json.dumps({**seen, "torch": "torch" in sys.modules}))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
