"""A fleet: replicas of one policy on many GPUs and machines, run by Ray Serve, behind one policy server.

    robot ── openpi's websocket ──▶ PolicyServer ── RemoteCalls ── channel ──▶ Replica on a GPU
    robot ──────────────────────▶      │                └───────── channel ──▶ Replica on another GPU

The server in front is the one of `turbopi serve`, with its whole protocol, limits and metrics; only its requests are
computed elsewhere: a robot's message goes on as it came (channel.py). It stores the running chunks of real-time
sessions. So a session belongs to the server, not to a replica: any replica may answer any request (remote_calls.py
chooses), and one that dies takes no session along. Which processes there are and where, whether they are well, and how
they are replaced: that is Ray Serve's part.

A request whose replica died is not tried again on another one: if it was the observation that killed it, one robot
would kill them all. The client gets an error, and may send it again.

Ray is imported when a fleet is started. docs/fleet.md is for users.
"""

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from packaging.specifiers import SpecifierSet

from turbopi.serve.calls import Policy
from turbopi.serve.fleet.remote_calls import RemoteCalls
from turbopi.serve.fleet.replica import Replica
from turbopi.serve.fleet.watch import Watch, answers
from turbopi.serve.metrics import Metrics
from turbopi.serve.options import ServerOptions
from turbopi.support.errors import BackendError, BackendUnavailable, ConfigError
from turbopi.support.installation import install_command

logger = logging.getLogger(__name__)

RAY = SpecifierSet(">=2.60,<3")
ROUTER = "turbopi.serve.fleet.ray_router.Places"
SCALING = "turbopi.serve.fleet.ray_router.by_requests"
DEPLOYMENT = "policy"  # the replicas' name inside of their application
HEALTH_PERIOD = 2.0  # seconds between Ray Serve's health checks of a replica
DRAIN_SECONDS = 30.0  # that a replica which is replaced may take for the requests that it has
START_TRIES = 3
POLL_SECONDS = 0.5
REACH_SECONDS = 3.0  # for an answer of a replica that may have ended
STARTED_HERE = {  # of a Ray that is started here
    "RAY_USAGE_STATS_ENABLED": "0",  # it reports to nobody
    "RAY_worker_niceness": "0",  # Ray's own 15 would let every other program on the machine go before the robots
}
TOKEN_LOGGER = "ray._private.authentication.authentication_token_setup"
TOKEN_LINES = "Token authentication is enabled"  # what begins the three lines that it says at every start
QUIET = {"log_level": "WARNING", "enable_access_log": False}  # a line for each request would cost more than it tells
OBJECT_STORE_BYTES = 256 * 2**20  # of a Ray that is started here: robots' observations don't go through it


@dataclass(frozen=True)
class FleetOptions:
    """How many replicas, and what each of them gets. Raises ConfigError for what can't be right.

    name            of the fleet: Ray Serve's application
    checkpoint      the name of its weights, for people: in metadata and metrics
    replicas        None: one for each GPU of the cluster, or one if it has none
    use_gpus        whether a replica gets a GPU; None: if the cluster has any
    cpus            CPUs that a replica takes of those that the cluster counts
    autoscaling     Ray Serve's `autoscaling_config`, instead of a number of replicas
    line            what a replica's own line and batches go by: `line_of` the server's options
    answer_seconds  after which a request without an answer is given up
    """

    name: str
    checkpoint: str
    replicas: int | None = None
    use_gpus: bool | None = None
    cpus: float = 1.0
    autoscaling: Mapping[str, Any] | None = None
    line: ServerOptions = field(default_factory=ServerOptions)
    answer_seconds: float = 120.0

    def __post_init__(self) -> None:
        if not self.name or not all(c.isalnum() or c in "-_." for c in self.name):
            raise ConfigError(f"a fleet's name is of letters, digits, - _ and ., not {self.name!r}")
        if self.replicas is not None and self.replicas < 1:
            raise ConfigError(f"replicas must be 1 or more, not {self.replicas}")
        if self.replicas is not None and self.autoscaling is not None:
            raise ConfigError("replicas and autoscaling were given: Ray Serve scales between its min_ and max_replicas")
        if not 0 < self.answer_seconds < float("inf"):
            raise ConfigError(f"answer_seconds must be more than 0 and finite, not {self.answer_seconds}")


def line_of(server: ServerOptions) -> ServerOptions:
    """Of the options of the server in front, what a replica's own line and batches go by: no key, no address."""
    return ServerOptions(
        queue_limit=server.queue_limit,
        max_batch=server.max_batch,
        execution=server.execution,
        control_hz=server.control_hz,
    )


# --- Ray --------------------------------------------------------------------------------------------------------------


def import_ray() -> tuple[Any, Any]:
    """The modules `ray` and `ray.serve`. Raises ConfigError if they can't be used."""
    try:
        import ray
        from ray import serve
    except ImportError as error:
        raise ConfigError(
            f"a fleet needs Ray Serve, which can't be imported ({error}): {install_command('ray')}"
        ) from error
    if ray.__version__ not in RAY:
        raise ConfigError(f"a fleet needs Ray {RAY}, but {ray.__version__} is installed: {install_command('ray')}")
    return ray, serve


def connect() -> bool:
    """Join the Ray cluster that this machine belongs to or RAY_ADDRESS names; without one, start Ray here.

    Returns whether it was started: then it ends with this process. Raises ConfigError for a cluster that isn't there or
    runs another version.
    """
    ray, _ = import_ray()
    for name, value in STARTED_HERE.items():
        os.environ.setdefault(name, value)
    quiet = {"logging_level": logging.WARNING, "configure_logging": True}
    logging.getLogger("ray.serve").setLevel(logging.WARNING)
    if ray.is_initialized():
        return False
    try:
        ray.init(address="auto", **quiet)
        return False
    except ConnectionError as error:
        if address := os.environ.get("RAY_ADDRESS"):
            raise ConfigError(
                f"no Ray cluster answers at RAY_ADDRESS={address}: {error}. One that has a token needs it here, too, "
                "in ~/.ray/auth_token, with RAY_AUTH_MODE=token in the environment"
            ) from error
    except (RuntimeError, ValueError) as error:  # other versions of Ray or Python there, an address that is none
        raise ConfigError(f"Ray's cluster can't be joined: {error}") from error
    with _silent_about_its_token():
        ray.init(address="local", include_dashboard=False, object_store_memory=OBJECT_STORE_BYTES, **quiet)
    return True


@contextmanager
def _silent_about_its_token() -> Iterator[None]:
    """Leave out what Ray says when it has turned token authentication on, as it does for every Ray that it starts.

    The token stays on. Ray's own setting for silence, RAY_AUTH_MODE=token, would have to be in the environment before
    Ray is imported, and then clusters without a token could no longer be joined.
    """
    rays = logging.getLogger(TOKEN_LOGGER)
    rays.addFilter(_isnt_about_its_token)
    try:
        yield
    finally:
        rays.removeFilter(_isnt_about_its_token)


def _isnt_about_its_token(record: logging.LogRecord) -> bool:
    return not record.getMessage().startswith(TOKEN_LINES)


def disconnect() -> None:
    """Leave the cluster; one that was started here ends."""
    ray, _ = import_ray()
    ray.shutdown()


def planned(options: FleetOptions) -> tuple[int, bool]:
    """How many replicas there are to be (with autoscaling, at first), and whether each has a GPU."""
    ray, _ = import_ray()
    gpus = int(ray.cluster_resources().get("GPU", 0))
    use_gpus = gpus > 0 if options.use_gpus is None else options.use_gpus
    if options.autoscaling is not None:
        wanted = options.autoscaling.get("initial_replicas") or options.autoscaling.get("min_replicas", 1)
        return max(int(wanted), 1), use_gpus
    return options.replicas or (max(gpus, 1) if use_gpus else 1), use_gpus


def check_capacity(options: FleetOptions) -> None:
    """Raise BackendUnavailable if the cluster hasn't the GPUs or CPUs for the fleet: Ray would wait for more machines.

    What a running fleet of that name has counts as free: its replicas are replaced one after the other.
    """
    ray, _ = import_ray()
    count, use_gpus = planned(options)
    total, free = ray.cluster_resources(), ray.available_resources()
    own = _running(options.name)
    for kind, each in (("GPU", 1.0 if use_gpus else 0.0), ("CPU", options.cpus)):
        have = free.get(kind, 0.0) + own * each
        if count * each > have + 1e-6:
            fit = "replica doesn't fit" if count == 1 else "replicas don't fit"
            if not total.get(kind):
                raise BackendUnavailable(
                    f"{count} {fit}: Ray's cluster has no {kind}. `turbopi doctor` says why none is seen; with "
                    "device cpu replicas run on CPUs"
                )
            raise BackendUnavailable(
                f"{count} {fit}, with {each:g} {kind} each: Ray's cluster has {total.get(kind, 0.0):g}, of which "
                f"{have:g} are free. Ask for fewer replicas, add machines (`ray start`), or end what takes them"
            )


def names() -> list[str]:
    """The fleets, and what else Ray Serve runs on the cluster."""
    _, serve = import_ray()
    return sorted(serve.status().applications)


def status_of(name: str) -> tuple[Any, Any]:
    """Ray Serve's application of that name now, and its deployment of replicas. None: there is none."""
    _, serve = import_ray()
    application = serve.status().applications.get(name)
    return application, None if application is None else application.deployments.get(DEPLOYMENT)


def check_is_fleet(name: str) -> None:
    """Raise ConfigError if Ray Serve runs something else under that name, such as an application of `serve run`."""
    application, _ = status_of(name)
    if application is not None and set(application.deployments) - {DEPLOYMENT}:
        raise ConfigError(
            f"Ray Serve runs an application {name!r} that `turbopi serve --ray` didn't start, with the deployments "
            f"{', '.join(sorted(application.deployments))}: take another name with --fleet NAME, or change it with "
            "Ray's own commands"
        )


def delete(name: str) -> None:
    """End the replicas of the fleet of that name, after their requests. If Ray has ended, they have, too."""
    _, serve = import_ray()
    if answers(address()):
        serve.delete(name)


def address() -> str:
    """host:port of the control service of the cluster that this process has joined."""
    ray, _ = import_ray()
    return str(ray.get_runtime_context().gcs_address)


def _running(name: str) -> int:
    """How many replicas the fleet of that name has now."""
    _, deployment = status_of(name)
    return 0 if deployment is None else int(deployment.replica_states.get("RUNNING", 0))


def why_unwell(name: str) -> str | None:
    """Why no replica of the fleet of that name runs; None if one does."""
    application, deployment = status_of(name)
    if deployment is None:
        return f"no replica runs: Ray Serve has no fleet {name!r} any more"
    if deployment.replica_states.get("RUNNING", 0):
        return None
    why = reason_in(deployment.message or application.message) or "its replicas are being started"
    return f"no replica of the fleet {name!r} runs ({deployment.status.value}): {why}"


def replicas(
    make_policy: Callable[[], Policy],
    options: FleetOptions,
    *,
    warm: Mapping[str, Any] | None,
    started_with: Mapping[str, Any] | None = None,
) -> Any:
    """The replicas as a Ray Serve application; arguments as Replica's. Raises ConfigError."""
    _, serve = import_ray()
    from ray.serve.config import RequestRouterConfig

    count, use_gpus = planned(options)
    scale: dict[str, Any] = {"num_replicas": count}
    if options.autoscaling is not None:
        scale = {"autoscaling_config": {"policy": {"policy_function": SCALING}, **options.autoscaling}}
        check_known(options.autoscaling)
    try:
        deployment = serve.deployment(
            name=DEPLOYMENT,
            ray_actor_options={"num_gpus": int(use_gpus), "num_cpus": options.cpus},
            health_check_period_s=HEALTH_PERIOD,
            graceful_shutdown_timeout_s=DRAIN_SECONDS,
            graceful_shutdown_wait_loop_s=POLL_SECONDS,
            max_constructor_retry_count=START_TRIES,
            request_router_config=RequestRouterConfig(request_router_class=ROUTER),
            **scale,
        )(Replica)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"Ray Serve refuses the fleet's options: {error}") from error
    return deployment.bind(make_policy, options.checkpoint, warm, options.line, started_with=started_with)


def check_known(autoscaling: Mapping[str, Any]) -> None:
    """Raise ConfigError for a field that Ray Serve's `autoscaling_config` hasn't: Ray Serve would ignore it."""
    from ray.serve.config import AutoscalingConfig

    known = {name for name in AutoscalingConfig.model_fields if not name.startswith("_")}
    if unknown := sorted(set(autoscaling) - known):
        raise ConfigError(
            f"autoscaling= has {', '.join(unknown)}, which Ray Serve's autoscaling_config hasn't; it has "
            f"{', '.join(sorted(known))}"
        )


def deploy(application: Any, name: str, report: Callable[[str], None]) -> None:
    """Start the replicas, or replace those of a fleet of that name one after the other, and wait until all serve.

    `report` gets what Ray says meanwhile. Raises BackendError if a replica can't start, with the reason.
    """
    _, serve = import_ray()
    serve.start(proxy_location="Disabled", logging_config=QUIET)  # the server in front has the port; once is enough
    target = serve.RunTarget(target=application, name=name, route_prefix=None, logging_config=QUIET)
    serve.run_many([target], wait_for_applications_running=False)
    last = ""
    while True:
        state, deployment = status_of(name)
        message = "" if deployment is None else deployment.message or (state.message if state else "")
        if state is not None and state.status == "RUNNING":
            return
        if state is not None and state.status in ("DEPLOY_FAILED", "UNHEALTHY"):
            raise BackendError(f"the replicas of {name!r} can't start: {reason_in(message or state.message)}")
        if message and message != last:
            last = message
            report(reason_in(message))
        time.sleep(POLL_SECONDS)


def reason_in(message: str) -> str:
    """The reason in a message of Ray Serve's that holds a traceback: the error's own line."""
    lines = [line.strip() for line in message.strip().splitlines()]
    named = [line for line in lines if line.partition(":")[0].rpartition(".")[2].endswith(("Error", "Unavailable"))]
    return (named or lines or [""])[-1 if named else 0]


# --- the server's side ------------------------------------------------------------------------------------------------


class Fleet:
    """The replicas as a policy for PolicyServer: `PolicyServer(fleet, calls=fleet.calls)`. `attach` makes one."""

    def __init__(self, handle: Any, name: str, about: Mapping[str, Any], answer_seconds: float) -> None:
        self._handle, self._answer_seconds = handle, answer_seconds
        self.metadata: dict[str, Any] = {**about, "fleet": name}

    @classmethod
    def attach(cls, name: str, answer_seconds: float = FleetOptions.answer_seconds) -> "Fleet":
        """The fleet of that name, whose replicas run already. Not for an event loop. Raises BackendError."""
        _, serve = import_ray()
        handle = serve.get_deployment_handle(DEPLOYMENT, app_name=name)
        return cls(handle, name, _call_replica(name, handle.about, answer_seconds), answer_seconds)

    def started_with(self) -> dict[str, Any]:
        """The options of the replicas' start: empty if they don't know. Raises BackendError."""
        name = str(self.metadata["fleet"])
        options: dict[str, Any] = _call_replica(name, self._handle.started_with, self._answer_seconds)
        return options

    def calls(self, metrics: Metrics, on_lost: Callable[[str], None] = lambda reason: None) -> RemoteCalls:
        name = str(self.metadata["fleet"])
        want = self._handle.about.remote  # Ray Serve, scaled to none, starts one then
        watch = Watch(address(), lambda: calls.reaches_any, partial(why_unwell, name))
        calls = RemoteCalls(name, metrics, self._answer_seconds, want, watch, on_lost)
        return calls

    def infer(self, obs: dict[str, Any], /, **arguments: Any) -> dict[str, Any]:
        """One request, by Ray Serve's own way. Raises BackendError if it gives no actions."""
        name = str(self.metadata["fleet"])
        result = _call_replica(name, self._handle.infer, self._answer_seconds, obs, arguments).result
        if result.answer is None:
            raise BackendError(f"the fleet {name!r} gave no actions: {result.text}")
        answer: dict[str, Any] = result.answer
        return answer


def _call_replica(name: str, method: Any, seconds: float, *arguments: Any) -> Any:
    """What a replica answers to a call."""
    from ray.exceptions import RayError
    from ray.serve.exceptions import RayServeException

    try:
        return method.remote(*arguments).result(timeout_s=seconds)
    except (TimeoutError, RayError, RayServeException) as error:
        why = f" within {seconds:g} s" if isinstance(error, TimeoutError) else f": {reason_in(str(error))}"
        raise BackendError(f"no replica of the fleet {name!r} answers{why}") from error
