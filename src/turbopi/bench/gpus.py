"""What NVIDIA publishes of the GPUs that users have: memory, bandwidth, matrix rates. The numbers: data/gpus.json.

Rates are dense and with float32 sums, as the policy needs them: GeForce cards do bf16 and FP8 with float32 sums at half
the rate of their advertised numbers. Where NVIDIA states a rate with sparsity, or of FP4 alone ("AI TOPS"), it is
divided by 2 for sparsity and by 2 for each doubling of the width; the GPU's `source` says so.
"""

import re
from functools import cache
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from turbopi.support.errors import ConfigError
from turbopi.support.reading import read_document, shown
from turbopi.support.text import names_known

FILE = Path(__file__).parents[1] / "data" / "gpus.json"
_Positive = Annotated[float, Meta(gt=0)]


class GpuSpec(Struct, frozen=True, kw_only=True):
    """A GPU's published numbers."""

    key: str  # as it is typed: "rtx4090"
    name: str
    compute_capability: str  # "8.9"
    memory_gb: _Positive  # 1e9 bytes; of Jetson shared with the CPU
    gb_per_second: _Positive  # memory bandwidth, 1e9 bytes
    bf16_tflops: _Positive
    fp8_tflops: _Positive | None  # E4M3; None: its tensor cores have no FP8
    int8_tops: _Positive  # int32 sums
    source: str

    @property
    def capability(self) -> tuple[int, int]:
        major, minor = self.compute_capability.split(".")
        return int(major), int(minor)

    def rate(self, precision: str) -> float | None:
        """Operations a second in "bf16", "fp8" or "int8"; None where the tensor cores haven't that."""
        tera = {"bf16": self.bf16_tflops, "fp8": self.fp8_tflops, "int8": self.int8_tops}[precision]
        return None if tera is None else tera * 1e12


class _Gpus(Struct, frozen=True):
    gpus: list[GpuSpec]


@cache
def published_gpus() -> dict[str, GpuSpec]:
    """All GPUs of the table, by key."""
    return {spec.key: spec for spec in read_document(FILE, _Gpus, ConfigError).gpus}


def find_gpu(name: str) -> GpuSpec:
    """The GPU that a user means: "rtx4090", "RTX 4090" and "GeForce RTX 4090" are one. Raises ConfigError."""

    def plain(text: str) -> str:
        short = re.sub(r"[^a-z0-9]", "", text.lower())
        for word in ("nvidia", "geforce", "jetsonagx", "jetson"):
            short = short.removeprefix(word)
        return short

    known, typed = published_gpus(), plain(name)
    by_name = {plain(spec.name): spec for spec in known.values()}
    if typed in by_name:
        return by_name[typed]
    if typed not in known:
        raise ConfigError(
            f"no published numbers of a GPU {shown(name)} are known here; {names_known(typed, 'known are', known)}. "
            "On the GPU itself `turbopi bench` measures"
        )
    return known[typed]
