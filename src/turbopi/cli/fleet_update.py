"""What `turbopi serve --ray --update` keeps of the running fleet, and what it changes.

Replicas know the options that they were started with. An update is that start again, with other weights: what its own
command line doesn't give stays as it is. What changes is told before any replica is replaced, be it by an option or by
what the new checkpoint says of itself.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from turbopi.cli.capabilities import check_warmup
from turbopi.cli.options import PolicyOptions
from turbopi.serve.options import ServerOptions
from turbopi.support.errors import ConfigError

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.serve.fleet.fleet import FleetOptions

OF_WEIGHTS = ("random_weights", "weights_seed", "quantization", "fp8_parts")  # not of those that come
OF_LINE = ("queue_limit", "max_batch", "execution", "control_hz")  # of the server's options: `fleet.line_of`
OF_SCALE = ("replicas", "gpus", "autoscaling")  # each says how many replicas there are
OF_CHECKPOINT = {  # what may come from a checkpoint, too: an option's name, and the metadata's
    "config": "config",
    "precision": "precision",
    "steps": "num_denoising_steps",
    "solver": "solver",
    "time_grid": "time_grid",
    "guidance": "guidance",
}


@dataclass(frozen=True)
class Requested:
    """The options that decide what a replica runs."""

    policy: PolicyOptions
    server: ServerOptions
    warmup: bool
    strict: bool

    def plain(self) -> dict[str, Any]:
        """By their names on the command line, without those of the weights that are random."""
        line = {name: getattr(self.server, name) for name in OF_LINE}
        values = {**asdict(self.policy), **line, "warmup": self.warmup, "strict": self.strict}
        return {name: value for name, value in values.items() if name not in ("random_weights", "weights_seed")}

    def kept(self, running: Mapping[str, Any], given: Collection[str]) -> "Requested":
        """The same, with the options of the running fleet for those that weren't given.

        Raises ConfigError if that isn't known, or contradicts itself.
        """
        if not running:
            raise ConfigError(
                "what the running fleet was started with isn't known here: `turbopi serve --ray` didn't start it. "
                "Replace its replicas by what did"
            )
        if running["quantization"] is not None and not {"quantization", "precision"} & set(given):
            raise ConfigError(
                f"the running fleet has --quantization {running['quantization']}, which was measured on its weights: "
                "give --quantization FILE of the new ones, or another --precision"
            )
        stays = {name: value for name, value in running.items() if name not in given and name not in OF_WEIGHTS}
        if "quantization" in given and "fp8_parts" not in given:
            stays["fp8_parts"] = running["fp8_parts"]
        of_policy = {field.name for field in fields(self.policy)}
        kept = Requested(
            policy=replace(self.policy, **{name: value for name, value in stays.items() if name in of_policy}),
            server=replace(self.server, **{name: value for name, value in stays.items() if name in OF_LINE}),
            warmup=stays.get("warmup", self.warmup),
            strict=stays.get("strict", self.strict),
        )
        check_warmup(kept.warmup, kept.strict, kept.server.max_batch)
        return kept


def scale_of(options: "FleetOptions", count: int, use_gpus: bool) -> dict[str, Any]:
    """How many replicas, and on what, for the next update. `count` and `use_gpus`: `fleet.planned` of the options."""
    autoscaling = None if options.autoscaling is None else dict(options.autoscaling)
    return {"replicas": None if autoscaling else count, "autoscaling": autoscaling, "use_gpus": use_gpus}


def scaled_as(options: "FleetOptions", running: Mapping[str, Any], given: Collection[str]) -> "FleetOptions":
    """As many replicas as the running fleet has, on GPUs as there, unless something else was given."""
    if not set(OF_SCALE) & set(given):
        options = replace(options, replicas=running["replicas"], autoscaling=running["autoscaling"])
    if not {"gpus", "device"} & set(given):
        options = replace(options, use_gpus=running["use_gpus"])
    return options


def runs(policy: PolicyOptions, opened: "Checkpoint") -> dict[str, Any]:
    """Of the metadata that a policy will have, what may come from its checkpoint. Raises ConfigError."""
    from turbopi.policy.call_options import Denoising

    fitting = policy.for_checkpoint(opened)
    return {
        "config": opened.config.name,
        "precision": fitting.precision_of(fitting.backend),
        **Denoising.of(opened.config, *fitting.flow_arguments).metadata,
    }


def changes(
    before: Mapping[str, Any], after: Mapping[str, Any], metadata: Mapping[str, Any], new: Mapping[str, Any]
) -> list[str]:
    """A line for each difference.

    before, after  the options that the replicas were started with, and those of the update
    metadata, new  the running policy's, and `runs` of the new one
    """
    named = [(name, metadata.get(key), new.get(key)) for name, key in OF_CHECKPOINT.items()]
    named += [(name, before.get(name), after[name]) for name in after if name not in OF_CHECKPOINT]
    return [f"{_spelled(name)}: {_said(old)} -> {_said(value)}" for name, old, value in named if old != value]


def as_before(typed: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """The running fleet's options that the update keeps though its command line alone would say something else."""
    kept = [(_spelled(name), value) for name, value in after.items() if value != typed.get(name, value)]
    return [
        f"--{'' if value else 'no-'}{name}" if isinstance(value, bool) else f"--{name} {_said(value)}"
        for name, value in kept
    ]


def of_the_front(given: Collection[str], decides: Collection[str]) -> list[str]:
    """Options that were given to an update, and are of the server in front, which it leaves as it is."""
    others = {*decides, *OF_SCALE, *OF_WEIGHTS, "checkpoint", "fleet", "ray", "update", "debug"}
    return sorted(f"--{_spelled(name)}" for name in given if name not in others)


def _spelled(name: str) -> str:
    return "a GPU each" if name == "use_gpus" else name.replace("_", "-")


def _said(value: object) -> str:
    if value is None:
        return "(default)"
    if isinstance(value, bool):
        return "on" if value else "off"
    return ",".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)
