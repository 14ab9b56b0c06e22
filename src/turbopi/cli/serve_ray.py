"""`turbopi serve --ray`: the options of a fleet, and its start and end."""

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from turbopi.cli.capabilities import check_server
from turbopi.cli.fleet_update import Requested, as_before, changes, of_the_front, runs, scale_of, scaled_as
from turbopi.cli.framework import Output
from turbopi.cli.options import PolicyOptions
from turbopi.support.errors import BackendError, ConfigError

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.policy.policy import UnifiedPolicy
    from turbopi.serve.fleet.fleet import FleetOptions

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
        help="Only replace the replicas of the running --fleet by this checkpoint's, one after the other. Options that "
        "aren't given stay as they are there.",
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

    def options(self, requested: Requested, checkpoint: str | None) -> "FleetOptions":
        """The fleet's options. Raises ConfigError."""
        from turbopi.serve.fleet.fleet import FleetOptions, line_of
        from turbopi.serve.fleet.ray_app import gpus_for, name_of, read_autoscaling

        name = name_of(checkpoint, requested.policy.random_weights)
        use_gpus = gpus_for(requested.policy.device)
        if self.gpus == "all" and use_gpus is False:
            raise ConfigError(
                f"--gpus all gives each replica a GPU, but --device {requested.policy.device} was asked for: leave "
                "out one of them; --replicas says how many run on CPUs"
            )
        return FleetOptions(
            name=self.name or name,
            checkpoint=name,
            replicas=self.replicas,
            use_gpus=True if self.gpus == "all" else use_gpus,
            autoscaling=read_autoscaling(self.autoscaling),
            line=line_of(requested.server),
        )


def serve_fleet(
    wishes: FleetWishes,
    requested: Requested,
    checkpoint: str | None,
    output: Output,
    *,
    given: Collection[str],
    before_serving: Callable[[], None],
) -> None:
    """Start the replicas, then serve until a signal; with `--update` only replace replicas.

    given  the options that were given, by their names here

    Raises ConfigError, CheckpointError, BackendUnavailable and BackendError for what can't be, and DeviceLost when
    Ray's cluster has ended.
    """
    from turbopi.serve.fleet import fleet

    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")  # what asks Ray after its end mustn't start another one
    fleet.import_ray()
    requested = replace(requested, policy=_for_workers(requested.policy))
    options = wishes.options(requested, checkpoint)
    if wishes.update:
        with _cluster(output.console) as ours:
            check_runs(options.name, [] if ours else fleet.names())
            _update(wishes, requested, checkpoint, output, given)
    else:
        opened = _open(requested, checkpoint, output)  # what is wrong with it shows here, not in a replica's log
        with _cluster(output.console):
            _serve(options, requested, checkpoint, opened, output, before_serving)


def _serve(
    options: "FleetOptions",
    requested: Requested,
    checkpoint: str | None,
    opened: "Checkpoint",
    output: Output,
    before_serving: Callable[[], None],
) -> None:
    from turbopi import serve as serving
    from turbopi.serve.fleet import fleet
    from turbopi.serve.fleet.name import claimed

    with claimed(options.name):
        fleet.check_is_fleet(options.name)
        if options.name in fleet.names():
            _check_orphan(options.name, requested.policy, opened, output)
        fleet.check_capacity(options)
        try:
            _deploy(options, requested, checkpoint, output)
            policies = fleet.Fleet.attach(options.name)
            before_serving()
            serving.run(policies, requested.server, console=output.console, calls=policies.calls)
        finally:
            fleet.delete(options.name)


def _check_orphan(name: str, policy: PolicyOptions, opened: "Checkpoint", output: Output) -> None:
    """Of a fleet whose server has ended without its replicas. Raises ConfigError if the new one doesn't fit."""
    from turbopi.serve.fleet import fleet

    try:
        metadata = fleet.Fleet.attach(name, fleet.REACH_SECONDS).metadata
    except BackendError as error:
        output.line(f"note: {error}; so what they run isn't compared", "yellow")
    else:
        check_fits(metadata, opened.config.model.action_horizon, robot_of(policy, opened))
    output.line(f"The fleet {name} is there without a server, which must have crashed: its replicas are replaced.")


def _update(
    wishes: FleetWishes, requested: Requested, checkpoint: str | None, output: Output, given: Collection[str]
) -> None:
    from turbopi.serve.fleet import fleet

    typed = requested.plain()
    name = wishes.name
    assert name is not None
    fleet.check_is_fleet(name)
    running = fleet.Fleet.attach(name)
    before = running.started_with()
    requested = requested.kept(before, given)
    opened = _open(requested, checkpoint, output)
    check_fits(running.metadata, opened.config.model.action_horizon, robot_of(requested.policy, opened))
    options = scaled_as(wishes.options(requested, checkpoint), before, given)
    fleet.check_capacity(options)
    after = requested.plain() | scale_of(options, *fleet.planned(options))
    if ignored := of_the_front(given, after):
        output.line(f"note: {', '.join(ignored)}: of the server in front, which an update leaves as it is", "yellow")
    if kept := as_before(typed, after):
        output.line(f"As in the running fleet: {', '.join(kept)}.")
    for line in changes(before, after, running.metadata, runs(requested.policy, opened)):
        output.line(line)
    count = _deploy(options, requested, checkpoint, output)
    output.line(f"Updated: {count} of {count} replicas run {options.checkpoint}.")


def _open(requested: Requested, checkpoint: str | None, output: Output) -> "Checkpoint":
    """The checkpoint, with what can be said of it before a replica loads it. Raises ConfigError and CheckpointError."""
    from turbopi.config import memory_of

    opened = requested.policy.open(checkpoint)
    text = opened.config.text
    if memory_of(opened.config.model) is not None or (text is not None and text.subtasks is not None):
        raise ConfigError(
            f"{opened.path} has memory, and the replicas of a fleet keep no robot's history: take `turbopi serve`"
        )
    # replicas may run elsewhere
    anywhere = replace(requested.policy, backend="pytorch", precision="bf16", device="cpu")
    check_server(replace(requested.server, max_batch=None), anywhere, opened, here=False)
    requested.policy.tell_if_random(opened, output)
    return opened


def _deploy(options: "FleetOptions", requested: Requested, checkpoint: str | None, output: Output) -> int:
    """Start or replace the replicas; returns their number."""
    from turbopi.serve.fleet import fleet
    from turbopi.serve.fleet.ray_app import warm_up_of

    count, use_gpus = fleet.planned(options)
    make = partial(make_policy, requested.policy, _absolute(checkpoint), requested.strict)
    warm = warm_up_of(requested.warmup, requested.server.execution)
    application = fleet.replicas(
        make, options, warm=warm, started_with=requested.plain() | scale_of(options, count, use_gpus)
    )
    output.line(
        f"Fleet {options.name}: {count} replica{'s' * (count > 1)} of {options.checkpoint}, "
        f"{'a GPU each' if use_gpus else 'on CPUs'}; loading and warming up …"
    )
    fleet.deploy(application, options.name, output.line)
    return count


def robot_of(policy: PolicyOptions, opened: "Checkpoint") -> str | None:
    """The robot's name as the policy's metadata will have it; None for a class of the user's, which isn't run here."""
    from turbopi.robots import robot_for

    config, requested = opened.config, policy.robot
    if ":" in (requested or config.robot):
        return None
    return robot_for(config.robot if requested is None else requested, config.robot, config.robot_options).name


def check_runs(name: str, running: list[str]) -> None:
    """Raise ConfigError unless there is something to update."""
    if name not in running:
        there = f"there: {', '.join(running)}" if running else "none does"
        raise ConfigError(f"no fleet {name!r} runs on this machine's Ray cluster; {there}")


def check_fits(metadata: Mapping[str, object], horizon: int, robot: str | None) -> None:
    """Raise ConfigError for new weights whose chunks are of another length or for another robot than the running ones.

    Robots know the metadata of those. `robot` None: it isn't known here.
    """
    if metadata.get("action_horizon") != horizon:
        raise ConfigError(
            f"the running fleet's chunks have {metadata.get('action_horizon')} actions, this checkpoint's {horizon}: "
            "start another fleet for it, with --fleet NAME"
        )
    if robot is not None and metadata.get("robot", robot) != robot:
        raise ConfigError(
            f"the running fleet is for the robot {metadata['robot']}, this checkpoint for {robot}: start another fleet "
            "for it, with --fleet NAME"
        )


def make_policy(options: PolicyOptions, checkpoint: str | None, strict: bool) -> "UnifiedPolicy":
    """A replica's policy, in its process."""
    return options.make_policy(options.open(checkpoint), Output(), strict=strict)


@contextmanager
def _cluster(console: Console) -> Iterator[bool]:
    """Ray, joined or started for this block; whether it was started."""
    from turbopi.serve.fleet import fleet

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
