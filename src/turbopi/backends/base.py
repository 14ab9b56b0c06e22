"""The protocol that every backend implements. The policy knows nothing else about the one it holds."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint.base import Room
from turbopi.config import ImageResize, ModelConfig
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import FloatPrecision, Trace
from turbopi.models.pi0.sample import Sample
from turbopi.quantization.plan import Precision

# Loads the checkpoint's tensors, by canonical name, to a device or a room (`Checkpoint.load`) in a precision.
LoadState = Callable[[torch.device | Room, FloatPrecision], dict[str, Tensor]]


class Begun(Protocol):
    """One observation whose pictures a backend works on already: what `Begins.begin` returns."""

    def finish(
        self,
        tokens: np.ndarray,
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None = None,
    ) -> Sample:
        """What `sample` of this one observation returns.

        tokens  int64[valid prompt tokens]
        state   float32[action_dim]
        noise   float32[H, action_dim]
        conditioning  of a backend that is `Conditions`, too
        """


class Backend(Protocol):
    """A way to run the model. All of them compute what `turbopi.models.pi0.reference.Pi0Model` computes.

    Observations and noise may be on the host or on the device; both are moved where they are needed. What only some
    can do besides are `Begins`, `RunsBatches`, `Submits`, `Conditions` and `RunsFp8`.

    any_horizon     whether noise may have another action horizon than the config's
    strict          whether a call that would capture, compile or build is refused with an ObservationError, made by
                    `cold_call`. Set by the policy; a backend that does nothing of the kind needn't look
    """

    name: ClassVar[str]
    precisions: ClassVar[tuple[Precision, ...]]
    any_horizon: ClassVar[bool]
    config: ModelConfig
    device: torch.device
    precision: Precision
    strict: bool

    def __init__(self, config: ModelConfig, load: LoadState, *, device: torch.device, precision: Precision) -> None:
        """Load the weights; whatever can be prepared without an observation is prepared here."""

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        """None if the backend can run on the device, else why it can't and what to do."""

    def warmup(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None = None,
        *,
        required: bool = True,
        last: bool = True,
    ) -> None:
        """Compile, allocate or capture whatever later observations with so many cameras may need, and so many steps.

        horizon     None: the config's
        required    False: not if that takes the minutes of building engines, or can't be at all
        last        whether no other cameras, steps or horizon will be warmed up, so that what that needs may be let go
        """

    def prefix(self, observation: Observation) -> KVCache:
        """Keys and values of an observation."""

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int) -> Tensor:
        """Actions float32[B, H, action_dim] on the device, from noise of that shape."""

    def sample(self, observation: Observation, noise: Tensor, num_steps: int) -> Sample:
        """Both halves, fused where the backend can: what the policy calls. Returns when the actions are on the host."""

    def intermediates(self, observation: Observation, noise: Tensor, num_steps: int) -> Trace:
        """The same computation with its named intermediates (kv_k, kv_v, v_t and actions at least), for judging it."""

    def describe(self) -> dict[str, Any]:
        """What a user may want to know of this instance, as plain values: goes into the policy's metadata."""


@runtime_checkable
class Begins(Protocol):
    """A backend that can start on an observation's pictures before its prompt is known."""

    def begin(self, pictures: Sequence[np.ndarray], resize: ImageResize | None = None) -> Begun:
        """Start on the valid pictures, on the host.

        pictures  (uint8|float32)[224, 224, 3], or of any size uint8[h, w, 3], then with
        resize    how the device is to resize them: to the last bit what `preprocess.images.fitted` makes of them

        They are copied, and `begin` returns without waiting for the device, so that the host can tokenise meanwhile. An
        observation that never gets to `finish` is given up by the next `begin`, `sample` or `prefix`.
        """


class BegunBatch(Protocol):
    """Several observations whose pictures a backend works on already: what `RunsBatches.begin_batch` returns."""

    def finish(
        self,
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditionings = None,
    ) -> Sample:
        """Actions of all of them, with the time of each stage of the whole batch.

        tokens  of each int64[valid prompt tokens]
        state   float32[B, action_dim]
        noise   float32[B, H, action_dim]
        conditioning  of a backend that is `Conditions`, too: for all of them or each, of the forms that were told
        """


@runtime_checkable
class RunsBatches(Protocol):
    """A backend whose batches are sooner than their observations one by one.

    batch_costs  how many plain observations it runs together, and how long that takes, in calls of one; other batches
        are split into these
    """

    @property
    def batch_costs(self) -> Mapping[int, float]: ...

    def begin_batch(
        self,
        pictures: Sequence[Sequence[np.ndarray]],
        resize: ImageResize | None = None,
        forms: Sequence[Form] | None = None,
    ) -> BegunBatch:
        """`Begins.begin` of several observations: each one's valid pictures, perhaps none.

        forms  of each observation's conditioning (`engine.loops.batch_form`), by which they are put together;
               None: all are plain
        """

    def warmup_batches(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None,
        batches: Sequence[int],
        conditioning: Conditioning | None = None,
    ) -> None:
        """Capture whatever batches of these sizes need if each observation has so many cameras as this one.

        conditioning  an example, for batches with observations of its form and times beside plain ones; None: for plain
                      ones alone
        """


@runtime_checkable
class Submits(Protocol):
    """A backend that has several observations in flight."""

    def submit(self, observation: Observation, noise: Tensor, num_steps: int) -> "Future[Sample]":
        """`sample` of one observation that returns at once."""


@runtime_checkable
class Conditions(Protocol):
    """A backend whose denoising loop takes a `Conditioning`, of these `forms`.

    A call without one, or with one of the form "plain", is the backend's ordinary call to the last bit. For a batch:
    one for all rows, or a list with one, or None, for each. `warmup` with one prepares calls of its form and times.
    """

    forms: ClassVar[tuple[Form, ...]]

    def warmup(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None = None,
        *,
        required: bool = True,
        last: bool = True,
        conditioning: Conditioning | None = None,
    ) -> None: ...

    def denoise(
        self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Tensor: ...

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample: ...

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace: ...


@runtime_checkable
class RunsFp8(Protocol):
    """A backend that has FP8 or INT8 among its precisions."""

    @classmethod
    def unavailable_in(cls, device: torch.device, precision: Precision) -> str | None:
        """Why this precision can't run on a GPU that the backend runs on; None if it can."""
