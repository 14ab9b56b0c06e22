"""Backends `pytorch` and `cuda_graph` of families whose models write their actions as tokens.

`cuda_graph`: for so many cameras three graphs, "vision", "prefix" for a prompt of any length, with the answer's first
token, and "step", one more token. Keys, values, ids, positions and the mark that an answer may be over lie in buffers
on the device, so steps are launched without waiting. The host looks at the mark every `LOOK` tokens: what is written
behind the end is dropped, at most `LOOK` - 1 tokens.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Sample, StageTimer, Trace
from turbopi.backends.captured import CapturedBackend
from turbopi.backends.captured_rows import Turn
from turbopi.backends.pytorch import PyTorchBackend
from turbopi.backends.pytorch_compile import PyTorchCompileBackend
from turbopi.engine.flat import Staged
from turbopi.engine.graph import Graph, Mark
from turbopi.engine.resize import Resizer
from turbopi.models import family_of
from turbopi.models.family import Ending
from turbopi.models.observation import Observation, Past
from turbopi.models.pi0.conditioning import Conditioning, Conditionings, Form
from turbopi.models.pi0.decoding import Decoding
from turbopi.models.pi0.kv_cache import KVCache
from turbopi.models.pi0_fast.reference import compacted
from turbopi.preprocess.pipeline import of_row
from turbopi.quantization.plan import WEIGHTS_ALONE, Precision
from turbopi.support.errors import ActionError, BackendUnavailable, ObservationError

if TYPE_CHECKING:
    from turbopi.engine.token import JoinedWeights

LOOK = 4
_FORCED = 16  # tokens whose logits are compared


def finished(decoding: Decoding, step: Graph, ending: Ending, most: int) -> list[list[int]]:
    """The answers behind a prefix, each to its end or `most` ids: `step` is launched without waiting for each."""
    written = 1
    while True:
        for _ in range(min(LOOK, most - written)):
            step.launch()
            written += 1
        if written == most or bool(decoding.ended.any()):
            rows = decoding.rows(ending, most)
            if rows is not None:
                return rows


class _Tokens(Backend):
    """What both refuse, and how answers become actions."""

    forms: ClassVar[tuple[Form, ...]] = ()
    any_horizon: ClassVar[bool] = False

    @classmethod
    def refuses_model(cls, config: Any) -> str | None:
        return None

    @classmethod
    def refuses_form(cls, form: Form) -> str | None:
        if form == "plain":
            return None
        return "a model that writes its actions as tokens has no solver, and its chunks can't be joined or guided"

    def refuses_horizon(self, horizon: int) -> str | None:
        return family_of(self.config).refuses_flow if horizon != self.config.action_horizon else None

    def prefix(self, observation: Observation) -> KVCache:
        raise self._lacks("halves of a call", "call `sample`")

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        raise self._lacks("halves of a call", "call `sample`")

    def _actions(self, rows: Sequence[Sequence[int]]) -> Tensor:
        """float32[B, H, action_dim]. Raises ActionError for the first answer that is broken."""
        assert self.reader is not None
        chunks = []
        for row, ids in enumerate(rows):
            try:
                chunks.append(self.reader.actions(ids))
            except ActionError as error:
                raise ActionError(of_row(row, len(rows), str(error))) from error
        return torch.from_numpy(np.stack(chunks))

    def _forced(self, noise: Tensor, num_steps: int) -> tuple[list[int], int]:
        """Ids that stand in for an answer's, drawn from a call's noise, and how many logits are compared.

        Whatever is rounded differently, the ids are the same.
        """
        ids = (noise.flatten().abs() * 1e6).long().cpu() % self.config.vocab_size
        count = min(_FORCED, num_steps, len(ids) + 1)
        return ids.tolist(), count


@dataclass(frozen=True)
class _Answered:
    actions: Tensor


class TokensBackend(_Tokens, PyTorchBackend):
    """The reference, eager."""

    def warmup(self, observation: Observation, num_steps: int, *arguments: Any, **options: Any) -> None:
        if not self._warm:
            self._written(observation, min(num_steps, 2), StageTimer(self.device))
        self._warm = True

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        self.check_conditioning(conditioning)
        timer = StageTimer(self.device)
        return Sample(self._actions(self._written(observation, num_steps, timer)), timer.milliseconds())

    def _written(self, observation: Observation, num_steps: int, timer: StageTimer) -> list[list[int]]:
        on_device = observation.to(self.device)
        if observation.batch_size == 1:
            on_device = compacted(on_device)
        rows: list[list[int]] = self.model.generate(on_device, self.reader, num_steps, mark=timer.mark)
        return rows

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        """The logits are those behind ids that were drawn from the noise."""
        self.check_conditioning(conditioning)
        trace: Trace = {}
        forced, count = self._forced(noise, num_steps)
        self.model.generate(observation.to(self.device), self.reader, count, trace=trace, forced=forced)
        assert self.reader is not None
        return trace | {"actions": self.sample(observation, noise, num_steps).actions}


@dataclass
class _Graphs:
    """Of so many cameras: the inputs' places, the graphs, the answer, and what `step` captured, with its buffers."""

    inputs: Observation
    staged: Staged
    resizer: Resizer | None
    vision: Graph
    prefix: Graph
    step: Graph
    decoding: Decoding
    one_token: Callable[[], None]
    horizon: int

    @property
    def steps(self) -> list[tuple[int, bool]]:  # as `CapturedBackend` says what is warm
        return [(self.horizon, False)]

    @property
    def loops(self) -> list[tuple[int, int]]:
        return []


class CapturedTokensBackend(_Tokens, CapturedBackend):
    """The reference in CUDA graphs: vision and prefix through torch.compile where there is a compiler, and a token by
    the engine (engine/token.py) where its sizes are for that. The engine alone has INT8 weights.
    """

    precisions: ClassVar[tuple[Precision, ...]] = ("bf16", "f32", WEIGHTS_ALONE)
    runs_batches: ClassVar[bool] = False
    _graphs: dict[tuple[int, int], _Graphs]  # type: ignore[assignment]

    def load_weights(self, load: LoadState) -> None:
        self._joined: JoinedWeights | None = None
        int8, why = self.precision == WEIGHTS_ALONE, PyTorchCompileBackend.unavailable(self.device)
        if why is None:  # Triton's kernels need a compiler, too
            from turbopi.engine import token

            why = token.refuses(self.config)
        if int8 and why is not None:
            raise BackendUnavailable(f"the engine's kernels alone read INT8 weights: {why}; take precision 'bf16'")
        super().load_weights(load)
        if why is None:
            self._joined = token.JoinedWeights(self.model, int8=int8)

    def describe(self) -> dict[str, Any]:
        by = "reference" if self._joined is None else "engine"
        return super().describe() | {"tokens_by": f"{by}, weights in INT8" if self.precision == WEIGHTS_ALONE else by}

    @property
    def _to_compile(self) -> tuple[Callable[..., Any], ...]:
        return self.model.embed_images, self._begin, self.model.step

    def _token_step(self, decoding: Decoding) -> Callable[[], None]:
        if self._joined is None:
            return partial(self._velocity, decoding)
        from turbopi.engine.token import TokenStep

        return TokenStep(self.model, self._joined, decoding)

    def _vision(self, observation: Observation, mark: Mark) -> Tensor:
        embedded: Tensor = self._embed_images(observation.images)
        return embedded

    def _begin(self, observation: Observation, decoding: Decoding, embedded: Tensor) -> None:
        self.model.begin(observation, decoding, embedded=embedded)

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
        self._captured(int(observation.image_mask[0].sum()))

    def answer(  # type: ignore[override]  # what is read of it is there
        self,
        turn: Turn,
        tokens: Sequence[np.ndarray],
        state: np.ndarray,
        noise: np.ndarray,
        num_steps: int,
        conditioning: Conditioning | None,
        timer: StageTimer,
        *,
        keep: bool = False,
    ) -> _Answered:
        graphs = self._started(turn, tokens)
        timer.mark("prefix")
        most = graphs.decoding.ids.shape[1]
        if num_steps > most:
            raise ObservationError(f"an answer of {num_steps} tokens was requested; there is room for {most}")
        assert self.reader is not None
        rows = finished(graphs.decoding, graphs.step, self.reader, num_steps)
        timer.mark("denoise")
        return _Answered(self._actions(rows))

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        """As the reference's. Places of the prefix that an observation hasn't are 0."""
        self.check_conditioning(conditioning)
        forced, count = self._forced(noise, num_steps)
        host, traces = observation.to("cpu"), []
        for row in range(host.batch_size):
            cameras, valid = host.image_mask[row], host.token_mask[row]
            turn = self.see([list(host.images[row][cameras].numpy())], "lerobot", [Past()])
            graphs = self._started(turn, [host.tokens[row][valid].numpy()])
            decoding, logits = graphs.decoding, []
            images = self.config.vision.num_tokens * int(cameras.sum())
            for one in (*forced[: count - 1], None):
                logits.append(decoding.logits.clone())
                if one is not None:
                    decoding.chosen.fill_(one)
                    graphs.step.launch()
            there = torch.cat((cameras.repeat_interleave(self.config.vision.num_tokens), valid))
            trace = {"logits": torch.stack(logits)}
            for name, caches in (("kv_k", decoding.keys), ("kv_v", decoding.values)):
                found = torch.stack([one[:, :, : images + int(valid.sum())].transpose(1, 2) for one in caches])
                trace[name] = found.new_zeros((*found.shape[:2], len(there), *found.shape[3:]))
                trace[name][:, :, there.to(found.device)] = found
            traces.append(trace)
        joined = {name: torch.cat([one[name] for one in traces], dim=1) for name in traces[0]}
        return joined | {"actions": self.sample(observation, noise, num_steps).actions}

    def _started(self, turn: Turn, tokens: Sequence[np.ndarray]) -> _Graphs:
        """Launch the prefix behind the images that `see` has begun on."""
        graphs: _Graphs = turn.graphs
        self._give_prompts(turn, tokens)
        graphs.prefix.launch()
        return graphs

    def _capture(self, cameras: int, batch: int) -> _Graphs:  # type: ignore[override]
        config = self.config
        inputs, staged = self._inputs(cameras, batch)
        assert self.reader is not None
        decoding = self.model.allocate(inputs, config.max_decoding_steps, self.reader.ends)
        seen = self._seen(inputs)

        def prefix(mark: Mark) -> None:
            self._prefix_of(inputs, decoding, seen.embedded)
            mark("prefix")

        one_token = self._token_step(decoding)

        def step(mark: Mark) -> None:
            one_token()
            mark("denoise")

        second, third = Graph(prefix, self._pool, self._stream), Graph(step, self._pool, self._stream)
        own = second, third, decoding, one_token, config.action_horizon
        return _Graphs(inputs, staged, seen.resizer, seen.graph, *own)
