"""How many GPUs a fleet of robots needs: arithmetic alone, from the times T(B) of a GPU.

Each robot asks for a chunk of H actions every s control steps, and has it d steps later: d ≤ s, or it would ask before
it has its answer, and d ≤ H - s, or it would run out of actions. The server gives all the same time, so that the
earliest deadline is who asked first, and forms batches as `BatchTimes.best` says.

The longest that one of n robots waits on a GPU. When it asks, others wait or run, each with one request, since d ≤ s.
If a turn runs, at most n - 1 of them wait, itself among them; the first m of those that wait are done after

    W(m) = max over r of T(k(r)) + W(m - k(r)),    r = m … n that may wait, k(r) of which run together

so it has its answer after at most max(W(n), longest turn + W(n - 1)).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from turbopi.errors import ConfigError
from turbopi.serve.batch_times import BatchTimes

ROUNDING = 1e-9  # of a control step: 3.0000000001 steps are 3


@dataclass(frozen=True)
class Fleet:
    """Robots that are all alike.

    hz                 control steps a second
    horizon            H, actions of a chunk
    execution_horizon  s, control steps from one request to the next; None: half of H
    delay_steps        the most control steps of delay; None: as many as s and H allow
    overhead_ms        of a request beyond the policy's part: the network, the server
    """

    robots: int
    hz: float
    horizon: int
    execution_horizon: int | None = None
    delay_steps: int | None = None
    overhead_ms: float = 0.0

    def __post_init__(self) -> None:
        """Raises ConfigError for numbers that don't fit each other."""
        if self.robots < 1 or self.horizon < 1 or not 0 < self.hz < math.inf or not 0 <= self.overhead_ms < math.inf:
            raise ConfigError(f"a fleet has robots, a control rate and a chunk above 0, not {self}")
        if not 1 <= self.steps <= self.horizon:
            raise ConfigError(f"the execution horizon is {self.steps}; expected 1 to {self.horizon}, a chunk's actions")
        if self.most_delay < 1:
            raise ConfigError(
                f"chunks of {self.horizon} actions of which {self.steps} are carried out before the next takes over "
                "leave no control step for computing it: take a shorter --execution-horizon or longer chunks"
            )
        if self.delay_steps is not None and not 1 <= self.delay_steps <= self.most_delay:
            raise ConfigError(
                f"the delay is to be {self.delay_steps} control steps at most; expected 1 to {self.most_delay}: "
                f"d ≤ s and d ≤ H - s, with s = {self.steps} and H = {self.horizon}"
            )

    @property
    def steps(self) -> int:
        """s."""
        return max(1, self.horizon // 2) if self.execution_horizon is None else self.execution_horizon

    @property
    def most_delay(self) -> int:
        """The most control steps that an answer may take: d ≤ s, d ≤ H - s."""
        return min(self.steps, self.horizon - self.steps)

    @property
    def allowed(self) -> float:
        """Seconds that the policy's part of a request may take at most."""
        most = self.most_delay if self.delay_steps is None else self.delay_steps
        return most / self.hz - self.overhead_ms / 1e3

    def delay(self, seconds: float) -> int:
        """Control steps until a chunk is there, of which the policy's part takes so long."""
        return max(1, math.ceil((seconds + self.overhead_ms / 1e3) * self.hz - ROUNDING))


@dataclass(frozen=True)
class Plan:
    """What a fleet needs.

    gpus            of that kind
    robots_per_gpu  on the GPU that has most
    batch           observations of a turn, at most: the server's --max-batch
    worst_seconds   from a request to its answer, without the overhead, if no turn takes longer than T(B)
    delay_steps     the same in control steps, with the overhead
    utilisation     the part of the time that the GPU with most robots computes, from 0 to 1
    """

    gpus: int
    robots_per_gpu: int
    batch: int
    worst_seconds: float
    delay_steps: int
    utilisation: float


def plan_fleet(fleet: Fleet, seconds: Mapping[int, float], max_batch: int | None = None) -> Plan:
    """The fewest GPUs that keep every robot's delay.

    seconds    T(B) by B; 1 is among them
    max_batch  no larger batches; None: none larger than the largest of `seconds`

    Raises ConfigError if a GPU isn't fast enough for one robot.
    """
    tables = [batch_times(seconds, size) for size in sorted(seconds) if max_batch is None or size <= max_batch]

    def worst(robots: int) -> tuple[float, int]:
        return min((worst_seconds(times, robots), times.largest) for times in tables)

    fastest = min(took / size for size, took in seconds.items())  # no order of turns makes more a second
    most, too_many = 0, min(fleet.robots, max(0, math.floor(fleet.allowed / fastest))) + 1
    while too_many - most > 1:  # what is enough for n robots is enough for fewer
        robots = (most + too_many) // 2
        if worst(robots)[0] <= fleet.allowed + ROUNDING / fleet.hz:
            most = robots
        else:
            too_many = robots
    if most == 0:
        alone, allowed = worst(1)[0], fleet.most_delay if fleet.delay_steps is None else fleet.delay_steps
        raise ConfigError(
            f"this GPU can't do it for a single robot: a call takes {alone * 1e3:.1f} ms, "
            f"with {fleet.overhead_ms:g} ms of overhead that is {fleet.delay(alone)} control steps at {fleet.hz:g} Hz; "
            f"{allowed} are allowed"
        )
    gpus = math.ceil(fleet.robots / most)
    robots = math.ceil(fleet.robots / gpus)
    took, largest = worst(robots)
    times = batch_times(seconds, largest)
    together = times.best(robots, 0.0)
    return Plan(
        gpus=gpus,
        robots_per_gpu=robots,
        batch=max(times.best(waiting, 0.0) for waiting in range(1, min(robots, largest) + 1)),
        worst_seconds=took,
        delay_steps=fleet.delay(took),
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
