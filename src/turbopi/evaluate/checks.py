"""Whether a policy, a simulator and a protocol fit, asked before the first episode."""

from collections.abc import Mapping
from typing import Any

from turbopi.evaluate.plan import Protocol
from turbopi.evaluate.sources import Answer, PolicyRefused, PolicySource
from turbopi.realtime import way_named
from turbopi.robots.base import Example
from turbopi.sim import SimSettings, Simulator
from turbopi.sim.base import faults_named, observation_problem
from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.reading import shown

_FREE = "--execution sync, async and ensemble need nothing of the policy"


def check_fit(source: PolicySource, simulator: Simulator, settings: SimSettings, image_px: int, replan: int) -> Answer:
    """Ask once, with an example. Raises ConfigError for a policy that can't act in this simulator."""
    from turbopi.preprocess.images import resize_with_pad

    with faults_named(simulator, "example()"):
        example = simulator.example(settings)
    problem = observation_problem(example, simulator.image_keys)
    if problem is not None:
        raise ConfigError(f"the example of an observation that {simulator.name} gives can't be used: {problem}")
    resized = {key: resize_with_pad(example[key], image_px, image_px) for key in simulator.image_keys}
    example = Example(example | resized)
    robot = f"use one for the robot {simulator.robot}, such as config pi05_{simulator.robot}"
    try:
        answer = source.infer([example], [0])[0]
    except (ObservationError, PolicyRefused) as error:
        raise ConfigError(f"the policy doesn't take the observations of {simulator.name}: {error}; {robot}") from error
    if answer.problem is not None:
        return answer  # of an example that no robot ever sees: episodes will show it
    horizon, width = answer.actions.shape
    if width != simulator.action_dim:
        raise ConfigError(
            f"the policy's actions have {width} numbers, but {simulator.name} needs {simulator.action_dim}; {robot}"
        )
    check_horizon(horizon, replan)
    return answer


def check_horizon(horizon: int, replan: int) -> None:
    """Raise ConfigError for chunks that end before the policy is asked again."""
    if horizon < replan:
        raise ConfigError(
            f"the policy's chunks have {horizon} actions, so it can't act {replan} steps before it is asked again: "
            f"give --replan {horizon} or less"
        )


def actions_needed(protocol: Protocol) -> int:
    """How many actions a chunk must have: those of the delay are skipped, unless the robot stands still meanwhile."""
    skipped = 0 if way_named(protocol.execution).stands_still else protocol.delay
    return protocol.replan + skipped


def check_delay(protocol: Protocol, simulator: Simulator, horizon: int) -> None:
    """Raise ConfigError for a delay that chunks of `horizon` actions, or the simulator, can't be run with.

    As `check_horizon`, too.
    """
    check_horizon(horizon, protocol.replan)
    way, most = way_named(protocol.execution), horizon - protocol.replan
    if way.mode is not None:  # as in `ChunkQueue`: the delay is at most the execution horizon
        most = min(most, protocol.replan)
    if protocol.delay > most and not way.stands_still:
        raise ConfigError(
            f"a delay of {protocol.delay} control steps doesn't fit --execution {way.name} with chunks of {horizon} "
            f"actions and an execution horizon of {protocol.replan}: at most {most} does; give another "
            "--execution-horizon, or a policy with longer chunks"
        )
    if protocol.control_hz is not None and not hasattr(simulator, "standing_still"):
        raise ConfigError(
            f"the simulator {simulator.name} doesn't say how its robot stands still (`standing_still`), so it can't be "
            "run in real time, where a policy may be late"
        )
    if protocol.delay and way.stands_still and not hasattr(simulator, "standing_still"):
        raise ConfigError(
            f"the simulator {simulator.name} doesn't say how its robot stands still (`standing_still`), so it can't be "
            f"run with --execution {way.name} and a delay"
        )


def check_way(source: PolicySource, protocol: Protocol) -> None:
    """Raise ConfigError if the policy doesn't offer the protocol's way to run, or not at that delay."""
    check_offered(source.real_time, source.about.get("server"), protocol)


def check_offered(reported: Mapping[str, Any], where: object, protocol: Protocol) -> None:
    """`check_way` of a policy that isn't there yet.

    told   what its metadata says under "real_time"
    where  the address of its server; None: it runs in this process
    """
    way = way_named(protocol.execution)
    who = "this policy" if where is None else f"the policy server at {where}"
    if way.mode is None:
        # with a control rate the executor says what it must know
        if reported.get("execution") is not None and protocol.control_hz is None:
            raise ConfigError(
                f"{who} joins chunks itself (it was started with --execution {shown(reported['execution'])}) "
                f"and counts actions by its own clock, which a simulated delay doesn't follow: start it without "
                "--execution, and give that to turbopi eval, or take --real-time"
            )
        return
    modes = reported.get("modes")
    if not isinstance(modes, list | tuple) or not modes:
        instead = "take a backend that joins chunks" if where is None else "serve the checkpoint with `turbopi serve`"
        raise ConfigError(
            f"--execution {way.name} tells the policy of the running chunk, but {who} joins no chunks (its metadata "
            f'has no "real_time"): {instead}; {_FREE}'
        )
    if way.mode not in modes:
        raise ConfigError(f"--execution {way.name} isn't offered by {who}, which offers {shown(modes)}; {_FREE}")
    longest = reported.get("trained_max_delay")
    if way.holds and isinstance(longest, int) and protocol.delay > longest:
        raise ConfigError(
            f"a delay of {protocol.delay} control steps doesn't fit --execution {way.name}: {who} was trained with "
            f"delays up to {longest}; give another --delay-steps, or --execution rtc"
        )
