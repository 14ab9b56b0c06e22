"""Serving a policy that keeps several observations in flight: `submit` instead of `infer`."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_helpers import policy_on
from serve_fakes import PipelinedFakePolicy, observation
from tensorrt_fakes import on_references
from test_serve_server import client, eventually, infer, metric, refused, stop_while_the_client_has_left
from websockets.exceptions import ConnectionClosed

from turbopi.backends.tensorrt.pipelined import TensorRTPipelinedBackend
from turbopi.checkpoint import random_checkpoint
from turbopi.realtime.wire import pack, unpack
from turbopi.serve import PolicyServer
from turbopi.serve import worker as worker_module

Test = Callable[[PolicyServer, PipelinedFakePolicy], Awaitable[None]]


def served(test: Test) -> None:
    async def main() -> None:
        policy = PipelinedFakePolicy()
        async with PolicyServer(policy, port=0) as server:
            try:
                await asyncio.wait_for(test(server, policy), 30)
            finally:
                policy.release.set()

    asyncio.run(main())


def test_the_next_request_is_handed_over_while_one_is_computed() -> None:
    async def test(server: PolicyServer, policy: PipelinedFakePolicy) -> None:
        async with client(server) as first, client(server) as second:
            await first.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            await second.send(pack(observation("behind it")))
            await eventually(lambda: policy.in_flight == 2)
            assert metric(server, "turbopi_inference_in_progress") == 1
            assert metric(server, "turbopi_queue_depth") == 0
            policy.release.set()
            replies = [unpack(bytes(await one.recv())) for one in (first, second)]  # type: ignore[arg-type]
            assert [reply["prompt"] for reply in replies] == ["hold", "behind it"]
            assert all(reply["server_timing"]["infer_ms"] > 0 for reply in replies)
            await eventually(lambda: metric(server, "turbopi_inference_in_progress") == 0)

    served(test)


def test_clients_get_their_own_answers_and_one_thread_submits() -> None:
    async def test(server: PolicyServer, policy: PipelinedFakePolicy) -> None:
        async def robot(number: int) -> None:
            async with client(server) as connection:
                for step in range(5):
                    assert (await infer(connection, observation(f"{number}/{step}")))["prompt"] == f"{number}/{step}"

        await asyncio.gather(*(robot(number) for number in range(6)))
        assert len(policy.submitters) == 1 and policy.in_flight == 0 and len(policy.seen) == 30

    served(test)


@pytest.mark.parametrize("prompt", ["refused at once", "nan"])
def test_a_bad_observation_is_a_text_frame_whenever_it_is_found(prompt: str) -> None:
    async def test(server: PolicyServer, policy: PipelinedFakePolicy) -> None:
        bad = observation(prompt)
        if prompt == "nan":
            bad["observation/state"] = np.full(8, np.nan)
        async with client(server) as connection:
            assert (await refused(connection, pack(bad))).startswith("bad observation: ")
            assert (await infer(connection, observation("next")))["prompt"] == "next"

    served(test)


def test_a_failure_in_flight_sends_its_traceback_and_costs_only_its_client() -> None:
    async def test(server: PolicyServer, policy: PipelinedFakePolicy) -> None:
        async with client(server) as broken, client(server) as other:
            assert "RuntimeError: CUDA error" in await refused(broken, pack(observation("crash")))
            with pytest.raises(ConnectionClosed):
                await broken.recv()
            assert (await infer(other, observation("on")))["prompt"] == "on"

    served(test)


def test_stopping_waits_for_what_is_in_flight_though_its_client_left() -> None:
    policy = PipelinedFakePolicy()
    asyncio.run(stop_while_the_client_has_left(policy))
    assert policy.in_flight == 0


def test_stopping_answers_what_is_in_flight() -> None:
    async def main() -> None:
        policy = PipelinedFakePolicy()
        server = PolicyServer(policy, port=0)
        await server.start()
        async with client(server) as leaving, client(server) as staying:
            await leaving.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            await leaving.close()
            await staying.send(pack(observation("behind it")))
            await eventually(lambda: policy.in_flight == 2)
            stop = asyncio.create_task(server.stop())
            await asyncio.sleep(0.1)
            assert not stop.done()
            policy.release.set()
            assert unpack(bytes(await staying.recv()))["prompt"] == "behind it"  # type: ignore[arg-type]
            await asyncio.wait_for(stop, 120)
        assert policy.in_flight == 0

    asyncio.run(main())


def test_an_answer_that_never_comes_holds_no_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "DRAIN_SECONDS", 0.05)

    async def main() -> None:
        policy = PipelinedFakePolicy()
        server = PolicyServer(policy, port=0)
        await server.start()
        async with client(server) as connection:
            await connection.send(pack(observation("hold")))
            await eventually(policy.started.is_set)
            stop = asyncio.create_task(server.stop())
            assert await connection.recv() == "the server is shutting down"
            await asyncio.wait_for(stop, 30)
        policy.release.set()

    asyncio.run(main())


@pytest.mark.slow
def test_a_pipelined_backends_served_actions_are_its_own(tmp_path: Path) -> None:
    """The real backend on its engines' twins, under three robots at once."""
    policy: Any = policy_on(
        on_references(TensorRTPipelinedBackend, tmp_path), random_checkpoint("pi05_tiny"), num_denoising_steps=2
    )
    assert policy.pipelined
    steady = policy._noise

    def noise(batch: int, horizon: int, given: Any, seed: Any) -> np.ndarray:
        return steady(batch, horizon, None, 0)

    policy._noise = noise  # all calls get the noise of one seed
    observations = [policy.example_observation(seed) for seed in range(3)]
    expected = [policy.infer(one)["actions"] for one in observations]
    # The CPU's sums in float32 depend on where memory lies: two calls of one thread may differ by 2e-6. Other robots'
    # actions, or those of another time, are 0.45 away.
    apart = min(np.abs(expected[one] - expected[other]).max() for one, other in ((0, 1), (0, 2), (1, 2)))
    assert apart > 0.1

    async def main() -> None:
        async def robot(number: int, server: PolicyServer) -> None:
            async with client(server) as connection:
                for _ in range(3):
                    reply = await infer(connection, observations[number])
                    assert np.abs(reply["actions"] - expected[number]).max() < apart / 1e4

        async with PolicyServer(policy, port=0) as server:
            await asyncio.gather(*(robot(number, server) for number in range(3)))

    asyncio.run(main())
