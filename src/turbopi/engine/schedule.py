"""Where a call's small steps run: tries, all off, that the script of docs/dev/log.md's section on stage boundaries sets.

What is captured keeps what it was captured with. A step is taken where the GPU has what it needs, else as ever.
"""

from dataclasses import dataclass


@dataclass
class Schedule:
    """ends_by_kernel  pictures come and actions leave by kernels of the graphs, not by the copy engine
    prompt_beside_vision  prompt, state and noise go up and are embedded while vision runs, on a stream of their own
    """

    ends_by_kernel: bool = False
    prompt_beside_vision: bool = False


SCHEDULE = Schedule()
