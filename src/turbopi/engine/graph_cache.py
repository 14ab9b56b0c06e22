"""CUDA graphs by name, captured when first needed; of denoising loops those used last are cached."""

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from turbopi.engine.graph import Graph
from turbopi.engine.loops import Loop
from turbopi.engine.plan import GraphKey
from turbopi.models.pi0.conditioning import Form

logger = logging.getLogger(__name__)

# A policy has one loop, a study a handful. What is cached of each step is up to 1.27 MB: Pi0.5's modulation (0.45 MB)
# and what the denoising kernel makes of it. So all loops together take 1.3 GB at most, and eight of ten steps 0.1 GB.
# Of a conditioned loop it is cached for each time that an action may have.
MOST_LOOPS = 8
MOST_STEPS = 1024  # of all loops together; one loop may always have as many as the policy takes


class LoopCache:
    """The loops in use, least recently used first.

    forget  is called with each loop that leaves. It waits for what may still run, and frees what is the loop's alone
    """

    def __init__(self, forget: Callable[[Loop], None]) -> None:
        self._forget = forget
        self._loops: dict[Loop, None] = {}
        self.forgotten = 0

    def __iter__(self) -> Iterator[Loop]:
        return iter(self._loops)

    def use(self, loop: Loop) -> None:
        """Make this loop the most recent one. If it is new, others may have to leave."""
        if loop == next(reversed(self._loops), None):
            return
        self.make_room(loop)
        self._loops.pop(loop, None)
        self._loops[loop] = None

    def make_room(self, loop: Loop) -> None:
        """Let go of the least recently used loops until this one fits."""
        while self._loops and loop not in self._loops and not fit((*self._loops, loop)):
            oldest = next(iter(self._loops))
            del self._loops[oldest]
            self.forgotten += 1
            logger.info("denoising in %s is evicted: its graphs are captured again when they are needed", oldest)
            self.evict(oldest)

    def evict(self, loop: Loop) -> None:
        """Let go of a loop that isn't among them any more, and of its evaluations' that no other loop has or is."""
        self._forget(loop)
        needed = {*self._loops, *(one for other in self._loops for one in other.evaluations)}
        for one in loop.evaluations:
            if one not in needed:
                self._forget(one)

    def describe(self) -> dict[str, Any]:
        return {
            "denoising_loops": [str(loop) for loop in list(self._loops)],
            "most_loops": MOST_LOOPS,
            "most_steps_together": MOST_STEPS,
            "forgotten": self.forgotten,
        }


class Captured(NamedTuple):
    """A graph, and the buffers that it reads and writes: images, a call, a packed prefix or a batch's loop."""

    graph: Graph
    buffers: Any


class GraphCache:
    """Graphs by key. What is here is captured: an entry, and its loop, are added when the capture has succeeded.

    Graphs for any loop stay for good; those of a loop leave with it. forget: as `LoopCache`'s
    """

    def __init__(self, forget: Callable[[Loop], None]) -> None:
        self.entries: dict[GraphKey, Captured] = {}
        self.loops = LoopCache(self._evict)
        self._forget = forget
        self._batch_sizes: dict[Form, frozenset[int]] = {}

    def get(self, key: GraphKey) -> Captured | None:
        """The entry, whose loop is the most recent one now; None: it isn't captured."""
        found = self.entries.get(key)
        if found is not None and key.loop is not None:
            self.loops.use(key.loop)
        return found

    def capture(self, key: GraphKey, make: Callable[[GraphKey], Captured]) -> Captured:
        """A new entry. If `make` fails, there is none, and nothing is left of a loop that has no other."""
        loop = key.loop
        if loop is not None:
            self.loops.make_room(loop)
        try:
            found = make(key)
        except BaseException:
            if loop is not None and loop not in self.loops:
                self.loops.evict(loop)
            raise
        self.entries[key] = found
        self._batch_sizes.clear()
        if loop is not None:
            self.loops.use(loop)
        return found

    def batch_sizes(self, form: Form) -> frozenset[int]:
        """Observations of the batched calls that are captured with a loop of this form."""
        if form not in self._batch_sizes:
            loops = ((key, key.loop) for key in self.entries if key.batch > 1 and not key.two_prompts)
            self._batch_sizes[form] = frozenset(key.batch for key, loop in loops if loop and loop.form == form)
        return self._batch_sizes[form]

    def describe(self) -> dict[str, Any]:
        return {"kept": len(self.entries), **self.loops.describe()}

    def _evict(self, loop: Loop) -> None:
        self._forget(loop)
        for key in [key for key in self.entries if key.loop == loop]:
            del self.entries[key]
        self._batch_sizes.clear()


def fit(loops: Iterable[Loop]) -> bool:
    """Whether so many loops are cached at once."""
    loops = list(loops)
    return len(loops) <= MOST_LOOPS and sum(loop.rows for loop in loops) <= MOST_STEPS
