"""What a site's activation looks like over many calls, and the scales that follow from it.

Values are counted by their first 16 bits as float32, sign aside: 128 bins an octave, over the whole range. That is fine
enough to say what any rounding to E4M3 (8 numbers an octave) or int8 (64 in the highest octave) would cost, without
keeping a value.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from turbopi.models import linears
from turbopi.models.observation import Observation
from turbopi.models.pi0.layers import AdaRMSNorm
from turbopi.models.pi0.sites import norm_of
from turbopi.quantization.directions import Rows
from turbopi.quantization.formats import FP8, Format
from turbopi.quantization.sites import Site
from turbopi.support.errors import ObservationError

BINS = 0x7F80  # the bins above hold infinities and NaN
HEADROOM = 2.0  # of what was seen; costs a floating-point format only some of its smallest numbers
PERCENTILE = 99.99

Method = Literal["max", "headroom", "percentile", "mse"]
METHODS: tuple[Method, ...] = get_args(Method)


class Histogram:
    """Counts of |x| on the host, and what they say of rounding to a format; `largest` is exact. counts float64[BINS]"""

    def __init__(self, counts: Tensor, largest: float, format: Format = FP8) -> None:
        self._format = format
        used = counts.nonzero().squeeze(1)  # a few thousand: the octaves that occur
        self.largest = largest
        self._bins, self._counts, self._values = used, counts[used], _centres()[used]
        self._scales: dict[Method, float] = {}

    def with_counts_of(self, other: "Histogram") -> "Histogram":
        """Of all that both have seen."""
        counts = torch.zeros(BINS, dtype=torch.float64)
        counts[self._bins] += self._counts
        counts[other._bins] += other._counts
        return Histogram(counts, max(self.largest, other.largest), self._format)

    def error(self, scale: float) -> tuple[float, float]:
        """(relative rms error of rounding to the format with a scale, part of the values that saturates)."""
        values = self._values.double()
        rounded = self._format.rounded(self._values, 1 / scale).float().double() * scale
        squares = float((self._counts * values**2).sum())
        wrong = float((self._counts * (rounded - values) ** 2).sum())
        beyond = float(self._counts[values > self._format.largest * scale].sum() / max(float(self._counts.sum()), 1.0))
        return (wrong / squares) ** 0.5 if squares else 0.0, beyond

    def percentile(self, percent: float) -> float:
        """The upper edge of the bin under which so many values are."""
        cumulated = self._counts.cumsum(0)
        index = int(torch.searchsorted(cumulated, cumulated[-1] * percent / 100))
        return float(_from_bits(min(int(self._bins[index]) + 1, BINS - 1) << 16))

    def scale(self, method: Method) -> float:
        """The scale that a method chooses; 1 where everything is 0."""
        if method not in self._scales:
            self._scales[method] = self._scale(method)
        return self._scales[method]

    def _scale(self, method: Method) -> float:
        if self.largest == 0:
            return 1.0
        most = self._format.largest
        if method == "max":
            return self.largest / most
        if method == "headroom":
            return self.largest * HEADROOM / most
        if method == "percentile":
            return max(self.percentile(PERCENTILE), self.largest / 1e6) / most
        tried = [self.largest / most * 2 ** (-step / 8) for step in range(-8, 41)]
        return min(tried, key=lambda scale: self.error(scale)[0])


def collect(
    model: Any,
    sites: Iterable[Site],
    batches: Iterable[tuple[Observation, Tensor]],
    steps: int,
    rows: dict[str, Rows] | None = None,
    format: Format = FP8,
) -> dict[str, Histogram]:
    """Run the reference on (observations, noise) and count what every site sees, over all denoising steps.

    `rows`, if given, gets some of each site's activations. The observations of a batch must have the same masks, as
    padding would be counted, too. Raises ObservationError if a site sees values that aren't finite.
    """
    counts: dict[str, Tensor] = {}
    largest: dict[str, Tensor] = {}
    with _watched(model, sites, counts, largest, rows):
        for observation, noise in batches:
            assert bool((observation.token_mask == observation.token_mask[:1]).all())
            assert bool((observation.image_mask == observation.image_mask[:1]).all())
            model.sample(observation, noise, steps)
    found = {}
    for name, bins in counts.items():
        on_host = bins.cpu().double()
        if on_host[BINS:].any():
            raise ObservationError(f"{name} sees values that aren't finite; are these weights or images damaged?")
        found[name] = Histogram(on_host[:BINS], float(largest[name]), format)
    return found


@contextmanager
def _watched(
    model: Any,
    sites: Iterable[Site],
    counts: dict[str, Tensor],
    largest: dict[str, Tensor],
    rows: dict[str, Rows] | None,
) -> Iterator[None]:
    handles = []

    def count(name: str, activation: Tensor) -> None:
        x = activation.detach().float().abs().flatten()
        bins = torch.bincount(x.view(torch.int32) >> 16, minlength=0x8000)
        top = x.amax()
        counts[name] = counts[name] + bins if name in counts else bins
        largest[name] = torch.maximum(largest[name], top) if name in largest else top

    def watch(name: str, norm: AdaRMSNorm | None) -> Any:
        def hook(module: torch.nn.Module, inputs: tuple[Tensor, ...]) -> None:
            if norm is None:
                count(name, inputs[0])
            if rows is not None:
                rows.setdefault(name, Rows(inputs[0].device)).add(inputs[0].detach().flatten(0, -2))

        return hook

    def watch_norm(name: str) -> Any:
        def hook(norm: AdaRMSNorm, inputs: tuple[Tensor, ...]) -> None:
            x, cond = inputs
            count(name, x.float() * (1 + norm.modulation(cond)[0]))

        return hook

    try:
        for site in sites:
            first, norm = next(linears(model, site)), norm_of(model, site)  # its siblings read the same
            handles.append(first.register_forward_pre_hook(watch(str(site), norm)))
            if norm is not None:
                handles.append(norm.register_forward_pre_hook(watch_norm(str(site))))
        yield
    finally:
        for handle in handles:
            handle.remove()


def _centres() -> Tensor:
    """float32[BINS]: the middle of every bin."""
    return ((torch.arange(BINS, dtype=torch.int32) << 16) | 0x8000).view(torch.float32)


def _from_bits(bits: int) -> Tensor:
    return torch.tensor(bits, dtype=torch.int32).view(torch.float32)
