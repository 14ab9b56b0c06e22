"""How action chunks join: the ways to run, without threads, clocks or PyTorch.

    queue = ChunkQueue("rtc", execution_horizon=5, delay=2)
    for every control step:
        if the policy has answered:
            queue.arrive(result)
        if queue.wants_observation:
            request = queue.observe()                              # the observation is taken now
            begin policy.infer(observation, **request.arguments)   # with a delay of 0, its result arrives here
        action = queue.next_action()                               # None: there is none, the robot holds

`turbopi.realtime` runs it beside a robot, `turbopi eval` under simulated delays. All counts are control steps.
docs/real_time.md says when to take which way.
"""

from turbopi.execution.delays import DelayEstimate
from turbopi.execution.queue import Action, ChunkQueue, Request, Seam
from turbopi.execution.ways import WAYS, Execution, Way, way_named

__all__ = ["WAYS", "Action", "ChunkQueue", "DelayEstimate", "Execution", "Request", "Seam", "Way", "way_named"]
