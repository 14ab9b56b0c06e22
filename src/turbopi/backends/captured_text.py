"""Backend `cuda_graph` of a Pi0.5 that writes the subtasks it acts on: the reference in graphs, text included.

Beside those of captured.py an observation has two graphs, for so many cameras: "text", what is continued, a prompt of
any length, with the first id, and "step", one more id (tokens.py). Both prompts use the images that "vision" embedded.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from turbopi.backends.base import LoadState, Sample, StageTimer
from turbopi.backends.captured import CapturedBackend
from turbopi.backends.captured_graphs import Graphs, Seen
from turbopi.backends.captured_rows import Turn, on_host
from turbopi.backends.tokens import finished
from turbopi.config import TextConfig
from turbopi.engine.flat import Staged
from turbopi.engine.graph import Graph, Mark
from turbopi.models.observation import Observation, Past, SeenObservation
from turbopi.models.pi0.conditioning import Conditionings, of_rows
from turbopi.models.pi0.decoding import Decoding
from turbopi.models.pi0.memory import Stages
from turbopi.models.pi0.prefix import embed_prompt
from turbopi.models.pi0.text import TO_EOS, TextWriter
from turbopi.support.errors import BackendError

if TYPE_CHECKING:
    from turbopi.engine.token import JoinedWeights


class _Stages(Stages):
    """Of a model without memory."""

    def embed_images(self, images: Tensor) -> Tensor:  # type: ignore[override]
        """[C, 224, 224, 3] -> [1, C * 256, D]"""
        return self._model.embed_images(images[None])[0]


@dataclass
class _TextGraphs:
    """Of so many cameras; one_token keeps the buffers that "step" was captured with."""

    text: Graph
    step: Graph
    decoding: Decoding
    one_token: Callable[[], None]


class CapturedTextBackend(CapturedBackend):
    """The reference of Pi0.5 in CUDA graphs; a token by the engine's kernels where its sizes are for that."""

    writes: ClassVar[bool] = True
    runs_batches: ClassVar[bool] = False

    def load_weights(self, load: LoadState) -> None:
        super().load_weights(load)
        self._texts: dict[int, _TextGraphs] = {}  # by number of cameras
        self._embedded: Tensor | None = None  # of the vision that was captured last
        self._joined: JoinedWeights | None = None

    def prepare_text(self, text: TextConfig, head: Tensor | None) -> None:
        self._text, self._words = text, TextWriter(self.model, text, head)
        if self._compiles:  # Triton's kernels need a compiler, too
            from turbopi.engine import token

            if token.refuses(self.config) is None:
                self._joined = token.JoinedWeights(self._words)
        self._read_text, self._token = self._stage(self._begin_text), self._stage(self._words.step)
        self.writer = _Writer(self)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"tokens_by": "reference" if self._joined is None else "engine"}

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        if not isinstance(observation, SeenObservation) or observation.seen is None:
            return super().sample(observation, noise, num_steps, conditioning=conditioning)
        self.check_conditioning(conditioning)
        (one,) = of_rows(conditioning, 1)
        timer, self._causal = StageTimer(self.device), observation.causal
        inputs = [observation.tokens[0].numpy()], observation.state.numpy(), noise.cpu().numpy()
        made = self.answer(observation.seen, *inputs, num_steps, one, timer)
        return Sample(made.actions.cpu(), timer.milliseconds())

    def see_images(self, observation: Observation) -> Turn:
        """Start on one observation's images: what `write` and `sample` need of it."""
        images, *_ = on_host(observation)
        return self.see(images, "lerobot", [Past()])

    def write(self, turn: Turn, tokens: np.ndarray, most: int) -> list[int]:
        """The ids behind a prompt, to EOS or `most` of them, at most those of the policy's `text`."""
        text = self._texts[turn.graphs.size[0]]
        if most > text.decoding.ids.shape[1]:
            raise BackendError(f"{most} tokens were requested; there is room for {text.decoding.ids.shape[1]}")
        self._give_prompts(turn, [tokens])
        text.text.launch()
        return finished(text.decoding, text.step, TO_EOS, most)[0]

    # -- graphs --------------------------------------------------------------------------------------------------------

    def _make_stages(self) -> Any:
        return _Stages(self.model)

    def _inputs(self, cameras: int, batch: int) -> tuple[Observation, Staged]:
        inputs, staged = super()._inputs(cameras, batch)
        return SeenObservation.of(inputs, causal=staged.tensors["causal"]) if self._is_joint else inputs, staged

    @property
    def _is_joint(self) -> bool:
        return self._text.subtasks is not None and self._text.subtasks.joint

    def _seen(self, inputs: Observation) -> Seen:
        seen = super()._seen(inputs)
        self._embedded = seen.embedded
        return seen

    def _capture(self, cameras: int, batch: int) -> Graphs:
        graphs = super()._capture(cameras, batch)
        inputs, embedded = graphs.inputs, self._embedded
        assert embedded is not None
        places = cameras * self.config.vision.num_tokens + self.config.max_prompt_tokens
        decoding = self._words.buffers_for(1, places, self._text.max_tokens, TO_EOS.ends)

        def text(mark: Mark) -> None:
            self._read_text(inputs.tokens, inputs.token_mask, embedded, decoding)
            mark("text")

        one_token = self._one_token(decoding)

        def step(mark: Mark) -> None:
            one_token()
            mark("text")

        first = Graph(text, self._pool, self._stream)
        first.launch()
        self._texts[cameras] = _TextGraphs(first, Graph(step, self._pool, self._stream), decoding, one_token)
        return graphs

    def _begin_text(self, tokens: Tensor, token_mask: Tensor, embedded: Tensor, decoding: Decoding) -> None:
        x = torch.cat((embedded, embed_prompt(self._words.vlm, tokens)), dim=1)
        valid = torch.cat((token_mask.new_ones(1, embedded.shape[1]), token_mask), dim=1)
        self._words.read_prefix(decoding, x, valid)

    def _one_token(self, decoding: Decoding) -> Callable[[], None]:
        if self._joined is None:
            return partial(self._token, decoding)
        from turbopi.engine.token import TokenStep

        return TokenStep(self._words, self._joined, decoding)


class _Writer:
    """`TextWriting` of the graphs."""

    def __init__(self, backend: CapturedTextBackend) -> None:
        self._backend = backend

    def see(self, observation: Observation) -> SeenObservation:
        return SeenObservation.of(observation, self._backend.see_images(observation))

    def write(self, observation: Observation, most: int) -> tuple[list[int], None]:
        assert isinstance(observation, SeenObservation)
        return self._backend.write(observation.seen, observation.tokens[0].numpy(), most), None
