"""What the executor needs of a policy: UnifiedPolicy, RealTimeClient, or openpi's WebsocketClientPolicy."""

import inspect
import logging
from collections.abc import Mapping
from typing import Any

from turbopi.realtime import Way
from turbopi.support.errors import ConfigError
from turbopi.support.text import kind_of

logger = logging.getLogger(__name__)


def metadata_of(policy: Any) -> Mapping[str, Any]:
    """What a policy tells of itself; empty if it tells nothing."""
    reported = getattr(policy, "metadata", None)
    if reported is None and hasattr(policy, "get_server_metadata"):  # openpi's client
        reported = policy.get_server_metadata()
    return reported if isinstance(reported, Mapping) else {}


def check_policy(policy: Any, way: Way) -> Mapping[str, Any]:
    """What it offers for real-time execution, of its metadata. Raises ConfigError if it can't be run in this way.

    Warns, in the log, of a policy with memory, whose history the executor doesn't keep.
    """
    if not callable(getattr(policy, "infer", None)):
        raise ConfigError(f"{kind_of(policy)} is no policy: it has no infer(observation)")
    metadata = metadata_of(policy)
    if "memory" in metadata:
        logger.warning(
            "this policy has memory, and the executor shows it only those observations that it computes chunks from: "
            "give those that `observe` returns False for to the policy's own `observe`, and call its `reset` after the "
            "warm-up and with each `reset`; else its history isn't that of training"
        )
    offered = metadata.get("real_time")
    offered = offered if isinstance(offered, Mapping) else {}
    if way.mode is None:
        return offered
    free = "execution 'sync', 'async' or 'ensemble' need nothing of the policy"
    if not _takes_previous(policy):
        raise ConfigError(
            f"execution {way.name!r} tells the policy of the running chunk, which {type(policy).__name__}.infer "
            f"doesn't take: use a UnifiedPolicy, or turbopi.realtime.client.RealTimeClient for a server; {free}"
        )
    modes = list(offered.get("modes", ()))
    if not modes:
        raise ConfigError(
            f"execution {way.name!r} needs a policy that joins chunks, and this {type(policy).__name__} offers no "
            f'real-time modes (its metadata has no "real_time"); {free}'
        )
    if way.mode not in modes:
        trained = (
            "it is for checkpoints that were trained with simulated delays, which say so: LeRobot's by "
            'rtc_training_max_delay, others in a turbopi.json, {"real_time": {"trained_max_delay": …}}; '
            if way.holds
            else ""
        )
        raise ConfigError(
            f"execution {way.name!r} isn't offered by this policy, which offers {', '.join(modes)}; {trained}{free}"
        )
    return offered


def server_joins(offered: Mapping[str, Any]) -> bool:
    """Whether the policy is a server that keeps the running chunk itself (`turbopi serve --execution`)."""
    return offered.get("execution") is not None


def _takes_previous(policy: Any) -> bool:
    try:
        parameters = inspect.signature(policy.infer).parameters.values()
    except (TypeError, ValueError):  # a callable without a signature
        return False
    return any(p.name == "previous" or p.kind is p.VAR_KEYWORD for p in parameters)
