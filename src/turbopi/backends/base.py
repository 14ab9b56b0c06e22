"""The base class of every backend, a way to run the model. The policy knows nothing else about the one it holds.

A backend gives `name`, `precisions`, `load_weights` and `sample`. All else has a default here: what a backend can do
besides is data on its class, and what it can't do is refused by this class, with the reason.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from turbopi.checkpoint.base import Room
from turbopi.config import FloatPrecision, ImageResize, Network, TextConfig
from turbopi.models import family_of
from turbopi.models.family import AnswerReader
from turbopi.models.observation import Observation, SeenObservation
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0.reference import Trace
from turbopi.models.pi0.sample import Sample
from turbopi.quantization.calibration_file import Quantization, check_given
from turbopi.quantization.plan import Precision
from turbopi.support.errors import BackendError, ConfigError, ObservationError

# Loads the checkpoint's tensors, by canonical name, to a device or a room (`Checkpoint.load`) in a precision.
LoadState = Callable[[torch.device | Room, FloatPrecision], dict[str, Tensor]]


class BegunBatch(Protocol):
    """Observations whose images a backend works on already: what `Backend.begin_batch` returns."""

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
        conditioning  for all of them or each, of the forms that `begin_batch` was given
        """


class TextWriting(Protocol):
    """What a backend that writes text has: models/pi0/text.py's `TextWriter`, or the same in graphs."""

    def see(self, observation: Observation) -> SeenObservation:
        """One observation, on the host, with its images embedded: for `write`, and for the actions behind it."""

    def write(self, observation: Observation, most: int) -> tuple[list[int], Any]:
        """The ids behind its prompt, to EOS, which is the last one, or `most` of them; and more."""


class Backend(ABC):
    """All backends compute what the reference of the model's family computes (`models.family_of`).

    Observations and noise may be on the host or on the device; both are moved where they are needed.

    name, precisions
                    its name among the backends, and the precisions that it runs in
    any_horizon     whether noise may have another action horizon than the config's
    forms           what its denoising loop takes beside openpi's. A call without a conditioning, or with one of the
                    form "plain", is the ordinary call to the last bit
    begins          whether it has `begin_batch`: it resizes images and starts on them before prompts are known
    runs_batches    whether it runs a batch sooner than its observations one by one, by `begin_batch`
    batch_forms     those of `forms`, beside "plain", of which it runs several together
    submits         whether it has `submit`: several observations may be in flight
    instead         what has every form and horizon that this one refuses, on a device and for models that it runs
    strict          whether a call that would capture, compile or build is refused with an ObservationError, made by
                    `engine.plan.cold_call`. Set by the policy; a backend that does nothing of the kind needn't look
    reader          of a model that writes its actions as tokens: what makes actions of them. Set by the policy
    writes, writer  whether it has `prepare_text`; what writes text, once that was called
    """

    name: ClassVar[str]
    precisions: ClassVar[tuple[Precision, ...]]
    any_horizon: ClassVar[bool] = True
    forms: ClassVar[tuple[Form, ...]] = ()
    begins: ClassVar[bool] = False
    runs_batches: ClassVar[bool] = False
    batch_forms: ClassVar[tuple[Form, ...]] = ("solver", "tokens", "jacobian")
    submits: ClassVar[bool] = False
    writes: ClassVar[bool] = False
    instead: ClassVar[str] = "backend 'pytorch'"
    strict = False
    reader: AnswerReader | None = None
    writer: TextWriting | None = None

    config: Any  # a Network; a backend that plans says `ModelConfig`

    def __init__(
        self,
        config: Network,
        load: LoadState,
        *,
        device: torch.device,
        precision: Precision,
        quantization: Quantization | None = None,
    ) -> None:
        """quantization: the calibration of these weights, for FP8 and INT8 alone. Raises ConfigError without it."""
        check_given(precision, quantization)
        self.config, self.device, self.precision, self._quantization = config, device, precision, quantization
        self.load_weights(load)

    @abstractmethod
    def load_weights(self, load: LoadState) -> None:
        """Load the weights; whatever can be prepared without an observation is prepared here."""

    @abstractmethod
    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        """Actions float32[B, H, action_dim] from noise of that shape. Returns when they are on the host.

        conditioning  one for all rows, or a list with one, or None, for each. A backend that takes none calls
                      `check_conditioning`
        """

    # -- what can be asked before there is an instance -----------------------------------------------------------------

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        """None if the backend can run on the device, else why it can't and what to do."""
        return None

    @classmethod
    def unavailable_in(cls, device: torch.device, precision: Precision) -> str | None:
        """Why this precision can't run on a GPU that the backend runs on; None if it can."""
        return None

    @classmethod
    def refuses_model(cls, config: Network) -> str | None:
        """Why it can't run a model of this family; None if it can. Here: it runs what the engine has a plan for."""
        if (family := family_of(config)).planned:
            return None
        return f"backend {cls.name!r} has no plan for {family.label}; take backend 'auto'"

    @classmethod
    def refuses_form(cls, form: Form) -> str | None:
        """Why the denoising loop doesn't take a form, and what to do; None if it does."""
        if form == "plain" or form in cls.forms:
            return None
        if form == "solver":
            return (
                f"backend {cls.name!r} takes Euler's steps on the uniform grid alone; take solver 'euler' and "
                f"time grid 'uniform', or take {cls.instead}"
            )
        if form == "two_prompts":
            return (
                f"backend {cls.name!r} has no guidance by a second prompt; take guidance 1, which is the prompt with "
                f"its tag alone, or 0, which is the one without, or take {cls.instead}"
            )
        if form == "two_prompts_jacobian":
            return (
                f"backend {cls.name!r} has no guidance by the true Jacobian (rtc) together with guidance by a second "
                "prompt; take mode rtc_identity or rtc_trained, or guidance 1 or 0"
            )
        whats = {"jacobian": "guidance by the true Jacobian", "noise": "chosen noise (paint)"}
        what = whats.get(form, "times, held actions or guidance by token")
        return f"backend {cls.name!r} has no {what}; leave out conditioning and previous, or take {cls.instead}"

    def check_conditioning(self, conditioning: Conditionings) -> None:
        """Raise ObservationError for a conditioning of a form that the backend doesn't have."""
        for one in conditioning if isinstance(conditioning, Sequence) else [conditioning]:
            if one is not None and (why := self.refuses_form(one.form)) is not None:
                raise ObservationError(why)

    def refuses_horizon(self, horizon: int) -> str | None:
        """Why a call can't have this action horizon, and what to do; None if it can."""
        if self.any_horizon or horizon == self.config.action_horizon:
            return None
        return (
            f"backend {self.name!r} has engines for the config's action horizon of {self.config.action_horizon}, not "
            f"for {horizon}; leave the horizon out, or take {self.instead}"
        )

    def prepare_text(self, text: TextConfig, head: Tensor | None) -> None:
        """Make `writer` around a Pi0.5's language model.

        head  [V, D]; None: the embedding table is the head
        """
        raise self._lacks("text", "take backend 'pytorch'")

    # -- before calls --------------------------------------------------------------------------------------------------

    def warmup(
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None = None,
        *,
        required: bool = True,
        last: bool = True,
        conditioning: Conditioning | None = None,
    ) -> None:
        """Compile, allocate or capture whatever later observations with so many cameras may need, and so many steps.
        Here: one call.

        horizon       None: the config's
        required      False: not if that takes the minutes of building engines, or can't be at all
        last          whether no other cameras, steps or horizon will be warmed up, so that what that needs may be freed
        conditioning  an example: calls of its form and times are prepared
        """
        actions = self.config.action_horizon if horizon is None else horizon
        self.sample(observation, torch.zeros(observation.batch_size, actions, self.config.action_dim), num_steps)

    def warmup_batches(  # noqa: B027  (a default, not a hole)
        self,
        observation: Observation,
        num_steps: int,
        horizon: int | None,
        batches: Sequence[int],
        conditioning: Conditioning | None = None,
    ) -> None:
        """Prepare batches of these sizes if each observation has so many cameras as this one. Here: nothing.

        conditioning  an example, for batches with observations of its form and times beside plain ones; None: for plain
                      ones alone
        """

    def describe(self) -> dict[str, Any]:
        """What a user may want to know of this instance, as plain values: goes into the policy's metadata."""
        return {}

    # -- calls that only some have -------------------------------------------------------------------------------------

    @property
    def batch_costs(self) -> Mapping[int, float]:
        """How many plain observations run together, and how long that takes, in calls of one. Other batches are split
        into these.
        """
        return {1: 1}

    def begin_batch(
        self,
        images: Sequence[Sequence[np.ndarray]],
        resize: ImageResize | None = None,
        forms: Sequence[Form] | None = None,
    ) -> BegunBatch:
        """Start on the valid images of one or several observations, on the host; each may have none.

        images  (uint8|float32)[224, 224, 3], or of any size uint8[h, w, 3], then with
        resize  how the device is to resize them: to the last bit what `preprocess.images.fitted` makes of them
        forms   of each observation's conditioning (`engine.conditioned.batch_form`), by which they are put together;
                None: all are plain

        They are copied, and `begin_batch` returns without waiting for the device, so that the host can tokenise
        meanwhile. Observations that never get to `finish` are given up by the next call.
        """
        raise self._lacks("a start on images before their prompts", "call `sample`")

    def submit(self, observation: Observation, noise: Tensor, num_steps: int) -> "Future[Sample]":
        """`sample` of one observation that returns at once."""
        pipelined = self.device.type == "cuda" and self.precision == "bf16" and family_of(self.config).planned
        raise ConfigError(
            f"backend {self.name!r} runs one observation at a time: submit(…, serially=True) runs it before submit "
            f"returns{', and backend tensorrt_pipelined has two in flight' * pipelined}"
        )

    # -- parts of a call, by which a backend is judged -----------------------------------------------------------------

    def prefix(self, observation: Observation) -> KVCache:
        """Keys and values of an observation."""
        raise self._lacks("halves of a call", "call `sample`")

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        """Actions float32[B, H, action_dim] on the device, from noise of that shape."""
        raise self._lacks("halves of a call", "call `sample`")

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        """The computation of `sample` with its named intermediates (kv_k, kv_v, v_t and actions at least)."""
        raise self._lacks("intermediate results to show", "it can't be verified")

    def _lacks(self, what: str, so: str) -> BackendError:
        return BackendError(f"backend {self.name!r} has no {what}; {so}")


class StageTimer:
    """Marks the end of each stage; the first one starts at construction. True on a GPU, too.

    On a GPU the marks are CUDA events and cost no synchronisation; `milliseconds` waits for the last of them.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._names: list[str] = []
        self._marks: list[torch.cuda.Event | float] = [self._now()]

    def mark(self, stage: str) -> None:
        self._names.append(stage)
        self._marks.append(self._now())

    def milliseconds(self) -> dict[str, float]:
        """Stage -> milliseconds since the mark before it."""
        if not isinstance(last := self._marks[-1], float):
            last.synchronize()  # not the device: another thread may be capturing a graph
        return {
            name: _elapsed_ms(start, end)
            for name, start, end in zip(self._names, self._marks, self._marks[1:], strict=False)
        }

    def _now(self) -> "torch.cuda.Event | float":
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
        event.record(torch.cuda.current_stream(self._device))
        return event


def _elapsed_ms(start: "torch.cuda.Event | float", end: "torch.cuda.Event | float") -> float:
    if isinstance(start, float):
        assert isinstance(end, float)
        return (end - start) * 1e3
    assert not isinstance(end, float)
    return float(start.elapsed_time(end))
