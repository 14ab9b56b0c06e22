"""What this process learns of a fleet's replicas from Ray Serve. Robots' requests don't come by here.

Ray Serve sends what is here as code, with copies of what it names: PLACES is named by its module.
"""

from typing import Any

from ray.serve.autoscaling_policy import replica_queue_length_autoscaling_policy
from ray.serve.request_router import RequestRouter

from turbopi.serve.fleet import channel


class Places(RequestRouter):  # type: ignore[misc]  # Ray's types aren't checked
    """A request router in Ray Serve's sense, for the sake of what that reports to it."""

    def update_replicas(self, replicas: list[Any]) -> None:
        super().update_replicas(replicas)
        channel.PLACES[self.app_name] = {str(one.replica_id): channel.Place(**one.replica_metadata) for one in replicas}

    async def choose_replicas(self, candidate_replicas: list[Any], pending_request: Any = None) -> list[list[Any]]:
        return [candidate_replicas]


def by_requests(context: Any) -> Any:
    """Ray Serve's usual autoscaling policy, with the requests that it doesn't see."""
    context.total_num_requests += sum((context.aggregated_metrics or {}).get("requests", {}).values())
    return replica_queue_length_autoscaling_policy(context)
