"""All labelled frames, in the GPU's memory."""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbopi_lab.small_policy.episodes import AUX_DIM, HORIZON, IMAGE_PX, Record
from turbopi_lab.small_policy.expert import PHASES
from turbopi_lab.small_policy.scenes import NUM_TASKS

FINE_PHASES = [PHASES.index("descend"), PHASES.index("close")]  # where millimetres count
FINE_WEIGHT = 1.5
LEARNER_WEIGHT = 1.5  # of frames that the learner led to


@dataclass
class Batch:
    """images uint8[B, 2, 224, 224, 3], chunks, executed float32[B, H, 7], leads, prompts, phases int64[B],
    aux float32[B, AUX_DIM]: see episodes.Record."""

    camera_images: Tensor
    chunks: Tensor
    executed: Tensor
    leads: Tensor
    prompts: Tensor
    phases: Tensor
    aux: Tensor


class Memory:
    """Filled by one thread while another samples from it: what has been counted never changes."""

    def __init__(self, capacity: int, device: torch.device) -> None:
        self.capacity, self.device, self.count = capacity, device, 0
        self.camera_images = torch.empty(capacity, 2, IMAGE_PX, IMAGE_PX, 3, dtype=torch.uint8, device=device)
        self.chunks = torch.empty(capacity, HORIZON, 7, device=device)
        self.executed = torch.empty(capacity, HORIZON, 7, device=device)
        self.leads = torch.empty(capacity, dtype=torch.int64, device=device)
        self.prompts = torch.empty(capacity, dtype=torch.int64, device=device)
        self.phases = torch.empty(capacity, dtype=torch.int64, device=device)
        self.aux = torch.empty(capacity, AUX_DIM, device=device)
        self.by_learner = torch.empty(capacity, dtype=torch.bool, device=device)
        self._stream: Any = torch.cuda.Stream(device) if device.type == "cuda" else None  # type: ignore[no-untyped-call]
        self._lock = threading.Lock()

    def add(self, record: Record, camera_images: np.ndarray) -> int:
        """Returns how many frames there was room for."""
        start = self.count
        n = min(len(record.chunks), self.capacity - start)
        if n <= 0:
            return 0
        with torch.cuda.stream(self._stream):
            span = slice(start, start + n)
            self.camera_images[span] = torch.from_numpy(camera_images[:n]).to(self.device)
            self.chunks[span] = torch.from_numpy(record.chunks[:n]).to(self.device)
            self.executed[span] = torch.from_numpy(record.executed[:n]).to(self.device)
            self.leads[span] = torch.from_numpy(record.leads[:n]).to(self.device)
            self.phases[span] = torch.from_numpy(record.phases[:n]).to(self.device)
            self.aux[span] = torch.from_numpy(record.aux[:n]).to(self.device)
            self.prompts[span] = record.setting.prompt
            self.by_learner[span] = record.kind != "demonstration"
        if self._stream is not None:
            self._stream.synchronize()
        with self._lock:
            self.count = start + n
        return n

    def draw(self, number: int) -> Tensor:
        """Indices int64[number]: every prompt as often as any other; fine phases and the learner's own states more."""
        n = self.count
        prompts = self.prompts[:n]
        weights = 1.0 / torch.bincount(prompts, minlength=NUM_TASKS).clamp(min=1)[prompts].float()
        fine = torch.isin(self.phases[:n], torch.tensor(FINE_PHASES, device=self.device))
        weights = weights * torch.where(fine, FINE_WEIGHT, 1.0) * torch.where(self.by_learner[:n], LEARNER_WEIGHT, 1.0)
        return torch.multinomial(weights, number, replacement=True)

    def batch(self, indices: Tensor) -> Batch:
        return Batch(
            self.camera_images[indices],
            self.chunks[indices],
            self.executed[indices],
            self.leads[indices],
            self.prompts[indices],
            self.phases[indices],
            self.aux[indices],
        )
