"""What a site's activations have in common, out of rows that stand for all that calibration sees."""

import torch
from torch import Tensor

from turbopi.quantization.fp8 import E4M3_MAX, Directions, to_e4m3

COUNT = 16  # directions of a site: 4 leave a seventh more error, 64 a tenth less (docs/quantization.md)
ROWS = 512  # of a site, in float32: 1.3 GB of the full model
LEAST_REST = 1e-6  # of the mean power: what is left is never nothing, or later weights would make up without bound


class Rows:
    """ROWS of all rows that came, each as likely as any other; the same ones for the same rows."""

    def __init__(self, device: torch.device) -> None:
        self._random = torch.Generator(device).manual_seed(0)
        self._keys, self.rows = torch.empty(0, device=device), torch.empty(0, 0, device=device)

    def add(self, x: Tensor) -> None:
        """x [rows, width]"""
        keys = torch.cat((self._keys, torch.rand(len(x), device=x.device, generator=self._random)))
        rows = torch.cat((self.rows, x.float())) if len(self.rows) else x.float()
        self._keys, kept = keys.topk(min(ROWS, len(keys)), largest=False)
        self.rows = rows[kept]


def directions(rows: Tensor) -> Directions | None:
    """The largest part of the second moment of rows [n, width]; None if there is nothing in them."""
    rows = rows.double()
    count, width = rows.shape
    power, vectors = torch.linalg.eigh(rows @ rows.T / count)
    power, vectors = power.flip(0).clamp(min=0), vectors.flip(1)
    num = min(COUNT, count, width)
    main = (rows.T @ vectors[:, :num] / count**0.5).float()
    scale = main.abs().amax(dim=0) / E4M3_MAX
    if not float(power[0]) > 0:
        return None
    main, scale = main[:, scale > 0], scale[scale > 0]
    rest = max(float(power[num:].sum()), LEAST_REST * float(power.sum())) / width
    return Directions(to_e4m3(main, 1 / scale), scale, rest)
