"""`turbopi serve --ray`: the options of a fleet, and its start and end."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from turbopi.cli.framework import Output
from turbopi.cli.offers import check_server
from turbopi.cli.options import PolicyOptions
from turbopi.errors import ConfigError
from turbopi.serve.options import ServerOptions

if TYPE_CHECKING:
    from turbopi.policy import UnifiedPolicy
    from turbopi.serve.fleet import FleetOptions

_FLEET = "Many GPUs"

Ray = Annotated[
    bool,
    typer.Option(
        "--ray",
        help="A fleet: replicas of the policy on the GPUs of a Ray cluster, or of this machine (docs/fleet.md).",
        rich_help_panel=_FLEET,
    ),
]
Replicas = Annotated[
    int | None,
    typer.Option(
        "--replicas",
        min=1,
        metavar="N",
        help="Unless given: one for each GPU, or one where there is none.",
        show_default=False,
        rich_help_panel=_FLEET,
    ),
]
Gpus = Annotated[
    str | None,
    typer.Option("--gpus", metavar="all", help="One replica for each GPU of the cluster.", rich_help_panel=_FLEET),
]
FleetName = Annotated[
    str | None,
    typer.Option("--fleet", metavar="NAME", help="Its name. Unless given: the checkpoint's.", rich_help_panel=_FLEET),
]
Autoscaling = Annotated[
    str | None,
    typer.Option(
        "--autoscaling",
        metavar="JSON",
        help='Ray Serve\'s autoscaling_config, such as {"min_replicas": 1, "max_replicas": 4}.',
        rich_help_panel=_FLEET,
    ),
]
Update = Annotated[
    bool,
    typer.Option(
        "--update",
        help="Only replace the replicas of the running --fleet by this checkpoint's, one after the other.",
        rich_help_panel=_FLEET,
    ),
]


@dataclass(frozen=True)
class FleetWishes:
    """What the command line says of a fleet."""

    ray: bool
    replicas: int | None
    gpus: str | None
    name: str | None
    autoscaling: str | None
    update: bool

    def check(self) -> None:
        """Raise ConfigError for options that contradict each other."""
        given = {
            "--replicas": self.replicas is not None,
            "--gpus": self.gpus is not None,
            "--fleet": self.name is not None,
            "--autoscaling": self.autoscaling is not None,
            "--update": self.update,
        }
        named = [name for name, there in given.items() if there]
        if named and not self.ray:
            raise ConfigError(f"{named[0]} is of a fleet: give --ray, too")
        if self.gpus not in (None, "all"):
            raise ConfigError(f"--gpus is all, or left out, not {self.gpus!r}: --replicas says how many GPUs are used")
        several = [name for name in ("--replicas", "--gpus", "--autoscaling") if given[name]]
        if len(several) > 1:
            raise ConfigError(f"{' and '.join(several)} each say how many replicas there are: give one of them")
        if self.update and self.name is None:
            raise ConfigError("--update needs the running fleet's name: --fleet NAME")

    def options(self, policy: PolicyOptions, checkpoint: str | None, server: ServerOptions) -> "FleetOptions":
        """The fleet's options. Raises ConfigError."""
        from turbopi.serve.fleet import FleetOptions, line_of
        from turbopi.serve.ray_app import gpus_for, name_of, read_autoscaling

        name = name_of(checkpoint, policy.random_weights)
        return FleetOptions(
            name=self.name or name,
            checkpoint=name,
            replicas=self.replicas,
            use_gpus=True if self.gpus == "all" else gpus_for(policy.device),
            autoscaling=read_autoscaling(self.autoscaling),
            line=line_of(server),
        )


def serve_fleet(
    wishes: FleetWishes,
    policy: PolicyOptions,
    checkpoint: str | None,
    server: ServerOptions,
    output: Output,
    *,
    warmup: bool,
    strict: bool,
    before_serving: Callable[[], None],
) -> None:
    """Start the replicas, then serve until a signal; with `--update` only replace replicas.

    Raises ConfigError, CheckpointError, BackendUnavailable and BackendError for what can't be.
    """
    from turbopi import serve as serving
    from turbopi.serve import fleet
    from turbopi.serve.ray_app import warm_up_of

    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")  # what asks Ray after its end mustn't start another one
    fleet.import_ray()
    options = wishes.options(policy, checkpoint, server)
    opened = policy.open(checkpoint)  # what is wrong with it shows here, not in a replica's log
    anywhere = replace(policy, backend="pytorch", precision=None, device="cpu")  # replicas may run on other devices
    check_server(replace(server, max_batch=None), anywhere, opened)
    policy.tell_if_random(opened, output)
    make = partial(make_policy, _for_workers(policy), _absolute(checkpoint), strict)
    with _cluster(output.console) as ours:
        if wishes.update:
            check_runs(options.name, [] if ours else fleet.names())
            check_fits(fleet.Fleet.attach(options.name).metadata, opened.config.model.action_horizon)
        fleet.check_room(options)
        application = fleet.replicas(make, options, warm=warm_up_of(warmup, server.execution))
        count, use_gpus = fleet.planned(options)
        output.line(
            f"Fleet {options.name}: {count} replica{'s' * (count > 1)} of {options.checkpoint}, "
            f"{'a GPU each' if use_gpus else 'on CPUs'}; loading and warming up …"
        )
        try:
            fleet.deploy(application, options.name, output.line)
            if wishes.update:
                output.line(f"Updated: {count} of {count} replicas run {options.checkpoint}.")
                return
            policies = fleet.Fleet.attach(options.name)
            before_serving()
            serving.run(policies, server, console=output.console, calls=policies.calls)
        finally:
            if not wishes.update:
                fleet.delete(options.name)


def check_runs(name: str, running: list[str]) -> None:
    """Raise ConfigError unless there is something to update."""
    if name not in running:
        there = f"there: {', '.join(running)}" if running else "none does"
        raise ConfigError(f"no fleet {name!r} runs on this machine's Ray cluster; {there}")


def check_fits(metadata: Mapping[str, object], horizon: int) -> None:
    """Raise ConfigError for new weights whose chunks have another length: robots know that of the old ones."""
    if metadata.get("action_horizon") != horizon:
        raise ConfigError(
            f"the running fleet's chunks have {metadata.get('action_horizon')} actions, this checkpoint's {horizon}: "
            "start another fleet for it"
        )


def make_policy(options: PolicyOptions, checkpoint: str | None, strict: bool) -> "UnifiedPolicy":
    """A replica's policy, in its process."""
    return options.make_policy(options.open(checkpoint), Output(), strict=strict)


@contextmanager
def _cluster(console: Console) -> Iterator[bool]:
    """Ray, joined or started for this block; whether it was started."""
    from turbopi.serve import fleet

    with console.status("Starting Ray …"):
        ours = fleet.connect()
    try:
        yield ours
    finally:
        fleet.disconnect()


def _for_workers(options: PolicyOptions) -> PolicyOptions:
    """The same with absolute paths: replicas run in other folders."""
    return replace(
        options,
        config=_absolute(options.config),
        robot=_absolute(options.robot),
        quantization=_absolute(options.quantization),
        tokenizer=_absolute(options.tokenizer),
    )


def _absolute(name: str | None) -> str | None:
    """A file's or folder's path, absolute; what names no file is left as it is."""
    return str(Path(name).resolve()) if name is not None and Path(name).exists() else name
