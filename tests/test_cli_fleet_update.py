"""What an update of a fleet keeps, and what it tells before it changes anything. Without Ray."""

from dataclasses import replace
from typing import Any

import pytest

from turbopi.checkpoint import random_checkpoint
from turbopi.cli.fleet_update import Requested, as_before, changes, of_the_front, runs, scale_of, scaled_as
from turbopi.cli.options import PolicyOptions
from turbopi.cli.serve_ray import robot_of
from turbopi.serve.fleet.fleet import FleetOptions
from turbopi.serve.options import ServerOptions
from turbopi.support.errors import ConfigError

TINY = PolicyOptions(random_weights="pi05_tiny")
FIRST = Requested(
    replace(TINY, backend="fused", precision="fp8", steps=5, device="cuda", default_prompt="fold the shirt"),
    ServerOptions(queue_limit=4, max_batch=16, execution="rtc", control_hz=50),
    warmup=True,
    strict=True,
)
TYPED = Requested(TINY, ServerOptions(port=1), warmup=True, strict=False)  # an update with nothing given
OPTIONS = FleetOptions("arms", "v1")


def running(**scale: Any) -> dict[str, Any]:
    """The options of a fleet of two, as its replicas tell them."""
    return FIRST.plain() | scale_of(replace(OPTIONS, **scale), 2, use_gpus=True)


def test_what_is_not_given_stays() -> None:
    after = TYPED.kept(running(), given=())
    assert after.plain() == FIRST.plain()
    assert after.server.port == 1, "the server in front has its own"
    scaled = scaled_as(replace(OPTIONS, use_gpus=None), running(), given=())
    assert (scaled.replicas, scaled.use_gpus, scaled.autoscaling) == (2, True, None)


def test_what_is_given_counts_be_it_the_default() -> None:
    requested = replace(TYPED, policy=replace(TINY, steps=10, backend="auto"))
    after = requested.kept(running(), given=("steps", "backend", "strict"))
    assert (after.policy.steps, after.policy.backend, after.strict) == (10, "auto", False)
    assert after.policy.precision == "fp8" and after.server.max_batch == 16


def test_autoscaling_stays_too_and_a_number_replaces_it() -> None:
    before = running(autoscaling={"min_replicas": 1, "max_replicas": 4})
    assert scaled_as(OPTIONS, before, given=()).autoscaling == {"min_replicas": 1, "max_replicas": 4}
    assert scaled_as(OPTIONS, before, given=()).replicas is None
    three = scaled_as(replace(OPTIONS, replicas=3), before, given=("replicas",))
    assert (three.replicas, three.autoscaling, three.use_gpus) == (3, None, True)
    assert scaled_as(replace(OPTIONS, use_gpus=False), before, given=("device",)).use_gpus is False


def test_a_calibration_is_not_kept_for_other_weights() -> None:
    before = running() | {"quantization": "/v1/q.json", "fp8_parts": "expert"}
    with pytest.raises(ConfigError, match=r"the running fleet has --quantization /v1/q.json, .* give --quantization"):
        TYPED.kept(before, given=())
    requested = replace(TYPED, policy=replace(TINY, quantization="/v2/q.json"))
    after = requested.kept(before, given=("quantization",)).policy
    assert (after.quantization, after.fp8_parts, after.precision) == ("/v2/q.json", "expert", "fp8")
    requested = replace(TYPED, policy=replace(TINY, precision="bf16"))
    after = requested.kept(before, given=("precision",)).policy
    assert (after.quantization, after.fp8_parts, after.precision) == (None, None, "bf16")


def test_what_is_kept_may_contradict_what_is_given() -> None:
    with pytest.raises(ConfigError, match="--strict refuses what warm-up didn't cover"):
        replace(TYPED, warmup=False).kept(running(), given=("warmup",))


def test_a_fleet_that_cannot_say_what_it_runs_is_not_updated() -> None:
    with pytest.raises(ConfigError, match="what the running fleet was started with isn't known here"):
        TYPED.kept({}, given=())


def test_each_change_is_told_on_a_line_and_what_stays_on_one() -> None:
    requested = replace(TYPED, policy=replace(TINY, precision="bf16"), server=ServerOptions(max_batch=1))
    after = requested.kept(running(), given=("precision", "max_batch"))
    metadata = {"config": "pi05_tiny", "precision": "fp8", "num_denoising_steps": 5, "solver": "euler"}
    metadata["time_grid"] = "uniform"
    new = runs(replace(after.policy, steps=None), random_checkpoint("pi05_tiny", 0, "auto"))
    lines = changes(running(), after.plain() | scale_of(OPTIONS, 3, use_gpus=True), metadata, new)
    assert lines == ["precision: fp8 -> bf16", "steps: 5 -> 10", "max-batch: 16 -> 1", "replicas: 2 -> 3"]
    assert as_before(requested.plain(), after.plain()) == [
        "--backend fused",
        "--steps 5",
        "--device cuda",
        "--default-prompt fold the shirt",
        "--queue-limit 4",
        "--execution rtc",
        "--control-hz 50",
        "--strict",
    ]


def test_options_of_the_server_in_front_are_told_to_change_nothing() -> None:
    given = ("checkpoint", "ray", "update", "fleet", "steps", "quantization", "replicas", "port", "max_clients")
    assert of_the_front(given, running()) == ["--max-clients", "--port"]


def test_the_robot_is_known_before_a_replica_loads_it() -> None:
    opened = random_checkpoint("pi05_tiny", 0, "auto")
    assert robot_of(TINY, opened) == "libero"
    assert robot_of(replace(TINY, robot="droid"), opened) == "droid"
    assert robot_of(replace(TINY, robot="mine:Arm"), opened) is None
