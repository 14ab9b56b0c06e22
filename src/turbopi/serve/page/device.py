"""Memory of the device that a policy runs on."""

import os
from collections.abc import Callable

import psutil

from turbopi.serve.page.messages import Memory


def memory_of(device: str) -> Callable[[], Memory]:
    """What tells the memory in use: of a GPU what PyTorch holds, else what this process does.

    `device` is the policy's: "cuda:0", "cpu". It is PyTorch's own count: the driver's would delay calls.
    """
    if device.startswith("cuda"):
        import torch

        total = int(torch.cuda.get_device_properties(device).total_memory)
        return lambda: Memory("GPU memory that PyTorch holds", torch.cuda.memory_reserved(device), total)
    process, total = psutil.Process(os.getpid()), psutil.virtual_memory().total
    return lambda: Memory("memory of this process", process.memory_info().rss, total)
