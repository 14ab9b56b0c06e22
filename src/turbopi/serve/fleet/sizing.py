"""How many GPUs a fleet of robots needs: arithmetic alone, from the times T(B) of a GPU.

Each robot requests a chunk of H actions every s control steps, and has it d steps later: d ≤ s, or its next request
would come before its answer, and d ≤ H - s, or it would run out of actions. With s = H it does run out, and stands
still for d. The server gives all the same time, so that the earliest deadline is the oldest request, and forms batches
as `BatchTimes.best` says.

The longest that one of n robots waits on a GPU. When its request comes, others wait or run, each with one request,
since d ≤ s. If a turn runs, at most n - 1 of them wait, itself among them; the first m of these are done after

    W(m) = max over r of T(k(r)) + W(m - k(r)),    r = m … n that may wait, k(r) of which run together

so it has its answer after at most max(W(n), longest turn + W(n - 1)).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from turbopi.serve.options import ServerOptions
from turbopi.serve.scheduling.batch_times import BatchTimes
from turbopi.support.errors import ConfigError

OVERHEAD_MS = 2.0  # of a request, usually: the network, the server
# More in a fleet, at most: of 16 clients on two GPUs the 99th percentile is 3.8 ms above that of 8 on one
# (h200_2026-11-30_fleet).
RAY_MS = 4.0
ROUNDING = 1e-9  # of a control step: 3.0000000001 steps are 3


@dataclass(frozen=True)
class Fleet:
    """Robots that are all alike.

    hz                 control steps a second
    horizon            H, actions of a chunk
    execution_horizon  s, control steps from one request to the next; None: half of H. H: they stand still for d
    delay_steps        the most control steps of delay; None: as many as s and H allow
    overhead_ms        of a request beyond the policy's part: the network, the server
    ray_ms             more of it with several GPUs, in a fleet
    """

    robots: int
    hz: float
    horizon: int
    execution_horizon: int | None = None
    delay_steps: int | None = None
    overhead_ms: float = 0.0
    ray_ms: float = 0.0

    def __post_init__(self) -> None:
        """Raises ConfigError for numbers that don't fit each other."""
        if self.robots < 1 or self.horizon < 1 or not 0 < self.hz < math.inf or not 0 <= self.overhead_ms < math.inf:
            raise ConfigError(f"a fleet has robots, a control rate and a chunk above 0, not {self}")
        if not 1 <= self.steps <= self.horizon:
            raise ConfigError(f"the execution horizon is {self.steps}; expected 1 to {self.horizon}, a chunk's actions")
        if self.delay_steps is not None and not 1 <= self.delay_steps <= self.most_delay:
            raise ConfigError(
                f"the delay is to be {self.delay_steps} control steps at most; expected 1 to {self.most_delay}: "
                f"d ≤ s and, unless s = H, d ≤ H - s, with s = {self.steps} and H = {self.horizon}"
            )

    @property
    def steps(self) -> int:
        """s."""
        return max(1, self.horizon // 2) if self.execution_horizon is None else self.execution_horizon

    @property
    def most_delay(self) -> int:
        """The most control steps that an answer may take: d ≤ s, d ≤ H - s."""
        return min(self.steps, self.horizon - self.steps or self.horizon)

    @property
    def allowed_steps(self) -> int:
        """Those that were requested, else as many as s and H allow."""
        return self.most_delay if self.delay_steps is None else self.delay_steps

    def overhead(self, gpus: int) -> float:
        """Milliseconds of a request beyond the policy's part."""
        return self.overhead_ms + (self.ray_ms if gpus > 1 else 0.0)

    def allowed(self, gpus: int) -> float:
        """Seconds that the policy's part of a request may take at most."""
        return self.allowed_steps / self.hz - self.overhead(gpus) / 1e3

    def delay(self, seconds: float, gpus: int) -> int:
        """Control steps until a chunk is there, of which the policy's part takes so long."""
        return max(1, math.ceil((seconds + self.overhead(gpus) / 1e3) * self.hz - ROUNDING))


@dataclass(frozen=True)
class Plan:
    """What a fleet needs.

    gpus            of that kind
    robots_per_gpu  on the GPU that has most
    batch           observations of a turn, at most: the server's --max-batch
    queue_limit     requests that may wait there: the server's --queue-limit
    worst_seconds   from a request to its answer, without the overhead, if no turn takes longer than T(B)
    delay_steps     the same in control steps, with the overhead
    utilisation     the part of the time that the GPU with most robots computes, from 0 to 1
    """

    gpus: int
    robots_per_gpu: int
    batch: int
    queue_limit: int
    worst_seconds: float
    delay_steps: int
    utilisation: float


def plan_fleet(
    fleet: Fleet, seconds: Mapping[int, float], max_batch: int | None = None, gpus: int | None = None
) -> Plan:
    """The fewest GPUs that meet every robot's delay.

    seconds    T(B) by B; 1 is among them
    max_batch  no larger batches; None: none larger than the largest of `seconds`
    gpus       exactly so many GPUs

    Raises ConfigError if a GPU isn't fast enough for one robot, or `gpus` aren't enough for all.
    """
    tables = [batch_times(seconds, size) for size in sorted(seconds) if max_batch is None or size <= max_batch]
    fastest = min(took / size for size, took in seconds.items())  # no order of turns makes more a second

    def worst(robots: int) -> tuple[float, int]:
        return min((worst_seconds(times, robots), times.largest) for times in tables)

    def fits(robots: int, of_gpus: int) -> bool:
        allowed = fleet.allowed(of_gpus) + ROUNDING / fleet.hz
        return robots * fastest <= allowed and worst(robots)[0] <= allowed

    def too_long(robots: int, of_gpus: int) -> str:
        took = worst(robots)[0]
        return (
            f"a request takes {took * 1e3:.1f} ms at most, with {fleet.overhead(of_gpus):g} ms of overhead that is "
            f"{fleet.delay(took, of_gpus)} control steps at {fleet.hz:g} Hz; {fleet.allowed_steps} are allowed"
        )

    def enough() -> int:
        if fits(fleet.robots, 1):
            return 1
        most, too_many = 0, fleet.robots
        while too_many - most > 1:  # what is enough for n robots is enough for fewer
            robots = (most + too_many) // 2
            most, too_many = (robots, too_many) if fits(robots, 2) else (most, robots)
        if most == 0:
            raise ConfigError(f"this GPU can't do it for a single robot: {too_long(1, fleet.robots)}")
        return math.ceil(fleet.robots / most)

    used = enough() if gpus is None else gpus
    robots = math.ceil(fleet.robots / used)
    if gpus is not None and not fits(robots, gpus):
        raise ConfigError(f"--gpus {gpus} can't do it: {too_long(robots, gpus)}; --gpus {enough()} would do")
    took, largest = worst(robots)
    times = batch_times(seconds, largest)
    together = times.best(robots, 0.0)
    return Plan(
        gpus=used,
        robots_per_gpu=robots,
        batch=max(times.best(waiting, 0.0) for waiting in range(1, min(robots, largest) + 1)),
        queue_limit=max(robots, ServerOptions.queue_limit),
        worst_seconds=took,
        delay_steps=fleet.delay(took, used),
        utilisation=robots * _seconds(times, together) / together * fleet.hz / fleet.steps,
    )


def batch_times(seconds: Mapping[int, float], largest: int) -> BatchTimes:
    """The server's table of these times, with batches up to `largest`."""
    times = BatchTimes(largest)
    for size, value in seconds.items():
        if size <= largest:
            times.measured(size, value)
    return times


def worst_seconds(times: BatchTimes, robots: int) -> float:
    """The longest that one of so many robots waits for its answer: see above."""
    turns = [0, *(times.best(waiting, 0.0) for waiting in range(1, min(robots, times.largest) + 1))]
    turns += turns[-1:] * (robots - times.largest)  # with more than a batch waiting it's the same one
    longest = max(_seconds(times, size) for size in turns[1:])
    done = [0.0] * (robots + 1)  # W
    # robots that wait may be more than m: then another size may run. Sizes by how many wait at least
    sizes: list[set[int]] = [set() for _ in range(robots + 2)]
    for waiting in range(robots, 0, -1):
        sizes[waiting] = sizes[waiting + 1] | {turns[waiting]}
    for m in range(1, robots + 1):
        done[m] = max(_seconds(times, size) + done[max(0, m - size)] for size in sizes[m])
    behind = longest + max(done[:robots]) if robots > 1 else 0.0
    return max(*done, behind)


def _seconds(times: BatchTimes, size: int) -> float:
    value = times.seconds(size, 0.0)
    assert value is not None
    return value
