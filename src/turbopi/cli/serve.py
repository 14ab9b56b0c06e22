"""`turbopi serve`."""

import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from turbopi.cli.api_key import ApiKey, chosen_key
from turbopi.cli.capabilities import check_server, check_warmup
from turbopi.cli.files import check_folder
from turbopi.cli.fleet_update import Requested
from turbopi.cli.framework import Output, command, log_to_stderr
from turbopi.cli.options import COMMON, ActingOptions, CheckpointArgument
from turbopi.cli.ports import why_not_free
from turbopi.cli.serve_ray import Autoscaling, FleetName, FleetWishes, Gpus, Ray, Replicas, Update, serve_fleet
from turbopi.cli.settings import PrintSettings, Settings, print_settings
from turbopi.serve.options import MAX_BATCH, ServerOptions
from turbopi.support.errors import ConfigError

if TYPE_CHECKING:
    from concurrent.futures import Future

    from turbopi.policy.history import History
    from turbopi.policy.policy import UnifiedPolicy
    from turbopi.realtime.running_chunk import JoinMode
    from turbopi.recordings.format import RecordImages

_NETWORK, _QUEUE = "Network", "Queue, batches, warm-up"
_REAL_TIME, _RECORDING = "Real-time execution", "Recording"


@command(
    "serve",
    shared=ActingOptions,
    common=(
        *("--host", "--port", "--api-key-file", "--record", "--max-batch", "--execution", "--control-hz"),
        *("--settings", "--print-settings", *COMMON),
    ),
    examples=(
        "turbopi serve checkpoints/pi05_libero --config pi05_libero",
        "turbopi serve checkpoints/mine --host 0.0.0.0 --api-key-file key",
        "turbopi serve checkpoints/mine --config pi05_droid --record recordings",
        "turbopi serve checkpoints/mine --execution rtc --control-hz 50",
        "turbopi serve checkpoints/mine --max-batch 16 --deadline-ms 200",
        "turbopi serve --random-weights pi05_tiny --port 8001",
        "turbopi serve --settings robot.toml",
        "turbopi serve checkpoints/mine --ray --gpus all",
    ),
)
def serve(
    options: ActingOptions,
    context: typer.Context,
    checkpoint: CheckpointArgument = None,
    host: Annotated[
        str, typer.Option("--host", rich_help_panel=_NETWORK, metavar="HOST", help="0.0.0.0 lets other machines in.")
    ] = ServerOptions.host,
    port: Annotated[
        int,
        typer.Option(
            "--port", "-p", rich_help_panel=_NETWORK, min=0, max=65535, metavar="N", help="0 takes a free one."
        ),
    ] = ServerOptions.port,
    api_key: ApiKey = None,
    api_key_file: Annotated[
        Path | None,
        typer.Option(
            "--api-key-file",
            rich_help_panel=_NETWORK,
            metavar="FILE",
            help="Clients must send `Authorization: Api-Key KEY`; the file's one line is the key. The variable "
            "TURBOPI_API_KEY does the same.",
        ),
    ] = None,
    allowed_hosts: Annotated[
        str | None,
        typer.Option(
            "--allowed-hosts",
            rich_help_panel=_NETWORK,
            metavar="NAME,NAME",
            help="Names, besides this machine's, by which web pages may address the server. Robots need none.",
        ),
    ] = None,
    max_message_mb: Annotated[
        float,
        typer.Option(
            "--max-message-mb", rich_help_panel=_NETWORK, metavar="MB", help="Larger messages end the connection."
        ),
    ] = ServerOptions.max_message_mb,
    queue_limit: Annotated[
        int,
        typer.Option(
            "--queue-limit", rich_help_panel=_QUEUE, min=0, metavar="N", help="Requests that may wait while one runs."
        ),
    ] = ServerOptions.queue_limit,
    max_batch: Annotated[
        int | None,
        typer.Option(
            "--max-batch",
            rich_help_panel=_QUEUE,
            min=1,
            max=MAX_BATCH,
            metavar="N",
            help="Observations of several robots that may run together, where warm-up has measured that this is "
            "sooner; 1: never. Default: 8, or fewer if they take seconds to measure.",
        ),
    ] = None,
    deadline_ms: Annotated[
        float,
        typer.Option(
            "--deadline-ms",
            rich_help_panel=_QUEUE,
            metavar="MS",
            help="From a request to its answer, for robots that don't send their own: it sets the order only, nothing "
            "is refused for it.",
        ),
    ] = ServerOptions.deadline_ms,
    max_clients: Annotated[
        int,
        typer.Option(
            "--max-clients",
            rich_help_panel=_NETWORK,
            min=1,
            metavar="N",
            help="Connected at once; more are refused (HTTP 503).",
        ),
    ] = ServerOptions.max_clients,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record",
            rich_help_panel=_RECORDING,
            metavar="DIR",
            help="Write observations and actions below DIR.",
        ),
    ] = None,
    record_limit: Annotated[
        str | None,
        typer.Option(
            "--record-limit",
            metavar="SIZE,AGE",
            rich_help_panel=_RECORDING,
            help="What stays below DIR, such as 20GB, 7d or 20GB,7d: the oldest calls are removed, and the log says "
            "how many. Unless given, all stays.",
        ),
    ] = None,
    record_images: Annotated[
        str,
        typer.Option(
            "--record-images",
            metavar="exact|png|jpeg",
            rich_help_panel=_RECORDING,
            help="png: the same pixels, smaller; jpeg: far smaller, pixels nearly the same.",
        ),
    ] = ServerOptions.record_images,
    page: Annotated[
        bool | None,
        typer.Option(
            "--page/--no-page",
            rich_help_panel=_NETWORK,
            help="A page for your browser on the same port: robots, images, action chunks, latency.",
            show_default="on, unless others could see it without an API key",
        ),
    ] = None,
    execution: Annotated[
        str | None,
        typer.Option(
            "--execution",
            rich_help_panel=_REAL_TIME,
            metavar="WAY",
            help="Join each client's chunks, the client unchanged: rtc, rtc_identity, rtc_trained, warm_start or "
            "paint, with --control-hz. See docs/real_time.md",
        ),
    ] = None,
    control_hz: Annotated[
        float | None,
        typer.Option(
            "--control-hz",
            rich_help_panel=_REAL_TIME,
            metavar="HZ",
            help="Actions that the robots carry out in a second.",
        ),
    ] = None,
    execution_horizon: Annotated[
        int | None,
        typer.Option(
            "--execution-horizon",
            rich_help_panel=_REAL_TIME,
            min=1,
            metavar="S",
            help="Actions of a chunk that the robots carry out before the next takes over. Default: half of a chunk.",
        ),
    ] = None,
    delay_steps: Annotated[
        int | None,
        typer.Option(
            "--delay-steps",
            rich_help_panel=_REAL_TIME,
            min=0,
            metavar="D",
            help="Control steps from an observation to its chunk, at the robot; 0 if it stands still meanwhile. "
            "Default: measured here, without the network.",
        ),
    ] = None,
    warmup: Annotated[
        bool,
        typer.Option(
            "--warmup/--no-warmup",
            rich_help_panel=_QUEUE,
            help="Compile and capture, before the first client, for every number of cameras that the robot may send.",
        ),
    ] = True,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            rich_help_panel=_QUEUE,
            help="Refuse requests that warm-up didn't cover, which would take a second or more.",
        ),
    ] = False,
    traces: Annotated[
        bool,
        typer.Option(
            "--traces",
            rich_help_panel=_NETWORK,
            help="Spans of each call to OpenTelemetry, where OTEL_EXPORTER_OTLP_ENDPOINT says (turbopi[otel]).",
        ),
    ] = False,
    settings: Settings = None,
    print_all: PrintSettings = False,
    ray: Ray = False,
    replicas: Replicas = None,
    gpus: Gpus = None,
    fleet: FleetName = None,
    autoscaling: Autoscaling = None,
    update: Update = False,
) -> None:
    """Serve a policy to openpi's clients.

    Speaks openpi's websocket protocol; /healthz, /metrics (Prometheus) and a page for people answer on the same port.
    Ctrl-C finishes the inference that runs, then stops.
    """
    if print_all:
        print_settings(context)
        return
    output = Output()
    options.check(checkpoint)
    wishes = FleetWishes(ray, replicas, gpus, fleet, autoscaling, update)
    wishes.check()
    check_warmup(warmup, strict, max_batch)
    shown = api_key is not None and api_key != os.environ.get("TURBOPI_API_KEY")
    wanted = ServerOptions(
        host=host,
        port=port,
        api_key=chosen_key(api_key, api_key_file),
        max_message_mb=max_message_mb,
        queue_limit=queue_limit,
        max_batch=max_batch,
        deadline_ms=deadline_ms,
        record_dir=record,
        record_limit=record_limit,
        record_images=cast("RecordImages", record_images),  # checked there
        allowed_hosts=[] if allowed_hosts is None else [name.strip() for name in allowed_hosts.split(",")],
        max_clients=max_clients,
        page=page,
        execution=cast("JoinMode | None", execution),  # checked there
        control_hz=control_hz,
        execution_horizon=execution_horizon,
        delay_steps=delay_steps,
        traces=traces,
    )
    if record is not None:
        check_folder(record)
    reason = None if update else why_not_free(host, port)
    if reason is not None:  # before minutes of loading, not after
        raise ConfigError(f"can't listen on {host}:{port}: {reason}. Choose another --host or --port")
    if shown:
        output.line(
            "note: `ps` shows a key on the command line to all; --api-key-file or TURBOPI_API_KEY hides it", "yellow"
        )
    if ray:
        given = [name for name in context.params if name != "settings" and _was_given(context, name)]
        requested = Requested(options, wanted, warmup, strict)
        serve_fleet(wishes, requested, checkpoint, output, given=given, before_serving=_log_all)
        return
    opened = options.open(checkpoint)
    check_server(wanted, options, opened)
    options.tell_if_random(opened, output)
    policy = options.make_policy(opened, output, strict=strict)

    from turbopi import serve as serving

    _log_all()
    serving.run(policy if warmup else _Cold(policy), wanted, console=output.console)


def _was_given(context: typer.Context, name: str) -> bool:
    """Whether an option is on the command line or in --settings, be it with its default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name in ("COMMANDLINE", "DEFAULT_MAP")


def _log_all() -> None:
    logging.getLogger("turbopi").setLevel(logging.INFO)
    log_to_stderr(stamped=True)


class _Cold:
    """A policy that isn't warmed up: the server warms up what has a `warmup`."""

    def __init__(self, policy: "UnifiedPolicy") -> None:
        self._policy = policy

    @property
    def metadata(self) -> dict[str, Any]:
        return self._policy.metadata

    @property
    def pipelined(self) -> bool:
        return self._policy.pipelined

    @property
    def gives_readings(self) -> bool:
        return getattr(self._policy, "gives_readings", False)  # a policy of one's own may have none

    def new_history(self) -> "History":
        return self._policy.new_history()

    def observe(self, obs: dict[str, object], /, **arguments: Any) -> None:
        self._policy.observe(obs, **arguments)

    def generate(self, obs: dict[str, object], /, **arguments: Any) -> str:
        return self._policy.generate(obs, **arguments)

    def infer(self, obs: dict[str, object], /, **arguments: Any) -> dict[str, object]:
        return self._policy.infer(obs, **arguments)

    def submit(self, obs: dict[str, object], /, **arguments: Any) -> "Future[dict[str, object]]":
        return self._policy.submit(obs, **arguments)
