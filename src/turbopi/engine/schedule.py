"""Where a call's small steps run: tries, all off, which are timed against the calls as they are.

What is captured keeps what it was captured with. A step is taken where the GPU has what it needs, else as ever.
"""

from dataclasses import dataclass


@dataclass
class Schedule:
    """
    ends_by_kernel        pictures come and actions leave by kernels of the graphs, not by the copy engine
    prompt_beside_vision  prompt, state and noise go up and are embedded while vision runs, on a stream of their own
    keys_beside_prefix    keys and values of all layers but the last are put in the denoising kernel's order on a branch
                          of the graph, while the rest of the prefix runs
    vision_in_two         patches are embedded by a graph of their own: the device has begun while the host is still
                          launching the large one
    marks_aside           timing events are recorded on a branch, so that no kernel waits for one
    """

    ends_by_kernel: bool = False
    prompt_beside_vision: bool = False
    keys_beside_prefix: bool = False
    vision_in_two: bool = False
    marks_aside: bool = False


SCHEDULE = Schedule()
