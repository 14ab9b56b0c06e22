"""What a policy will offer, told from its configuration and backend before minutes of loading its weights."""

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from turbopi.serve.options import ServerOptions
from turbopi.support.errors import ConfigError

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.cli.options import PolicyOptions
    from turbopi.realtime.running_chunk import JoinMode


@dataclass(frozen=True)
class Capabilities:
    """`UnifiedPolicy`'s attributes of these names, and its metadata's `real_time`."""

    real_time: Mapping[str, Any]
    pipelined: bool
    batch_modes: "tuple[JoinMode, ...]"


def capabilities_of(options: "PolicyOptions", checkpoint: "Checkpoint", *, here: bool = True) -> Capabilities:
    """Of the policy that `make_policy` will make. Raises ConfigError and BackendUnavailable, as that does.

    here  whether it will be made on this machine: else nothing is said of that
    """
    from turbopi import backends
    from turbopi.checkpoint.quantized_folder import precision_kept
    from turbopi.policy.call_options import Denoising
    from turbopi.policy.chunk_conditioning import ChunkConditioning
    from turbopi.policy.kept_precision import check_backend

    fitting = options.for_checkpoint(checkpoint)
    device, precision = backends.resolve_device(fitting.device), fitting.precision_of(fitting.backend)
    model, name, writes = checkpoint.config.model, fitting.backend, checkpoint.config.writes_subtasks
    if name == "auto":
        bar, kept = sys.stderr.isatty(), precision_kept(checkpoint) is not None
        backends.qualified(device, precision, model, bar=bar, writes=writes, kept=kept)  # type: ignore[arg-type]
        name = backends.choose(device, precision, model, writes=writes)[0]  # type: ignore[arg-type]
    if here:
        check_backend(name, device, precision, checkpoint)  # type: ignore[arg-type]
    cls = backends.class_for(name, model, writes=writes)
    requested = Denoising.of(checkpoint.config, *fitting.flow_arguments)
    no_pipeline: Any = None  # no observation is read
    own = requested.integration, requested.two_prompts
    joins = ChunkConditioning(checkpoint.config, no_pipeline, cls, *own)
    batches = cls.runs_batches and requested.runs_together
    return Capabilities(
        real_time={"modes": list(joins.modes), **asdict(checkpoint.config.real_time)},
        pipelined=cls.submits,
        batch_modes=joins.batch_modes if batches else (),
    )


def check_server(
    server: ServerOptions, options: "PolicyOptions", checkpoint: "Checkpoint", *, here: bool = True
) -> None:
    """Raise ConfigError for options of a server that the policy won't be able to follow. here: `capabilities_of`'s."""
    if (server.execution, server.execution_horizon, server.delay_steps, server.max_batch) == (None,) * 4:
        return
    from turbopi.serve.calls import largest_batch
    from turbopi.serve.real_time import check_execution

    offered = capabilities_of(options, checkpoint, here=here)
    check_execution(server, offered.real_time, checkpoint.config.model.action_horizon)
    largest_batch(server, pipelined=offered.pipelined, batch_modes=offered.batch_modes)


def check_warmup(warmup: bool, strict: bool, max_batch: int | None) -> None:
    """Raise ConfigError for what needs the warm-up."""
    if strict and not warmup:
        raise ConfigError("--strict refuses what warm-up didn't cover: with --no-warmup that would be everything")
    if max_batch is not None and max_batch > 1 and not warmup:
        raise ConfigError(f"--max-batch {max_batch} needs the warm-up, which measures batches: leave out --no-warmup")
