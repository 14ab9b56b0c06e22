"""The learner at the wheel: chunks for a few images at once, with the newest averaged weights, in bfloat16."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from turbopi.config import ModelConfig
from turbopi.models.pi0.denoise import euler_step, run_expert, time_embedding, time_grid
from turbopi.models.pi0.layers import rope_tables
from turbopi.models.pi0.prefix import embed_images, embed_prompt, prefix_keys_values
from turbopi.models.pi0.reference import Pi0Model, parameter_dtype
from turbopi.preprocess.normalize import Normalizer
from turbopi_lab.small_policy.episodes import HORIZON, IMAGE_PX

NUM_STEPS = 10


class Actor:
    """Rows beyond those asked for are computed and thrown away: on a GPU one captured graph serves every size.

    Actions that are held stay as they are, at time 0 (see forward.py).

    tokens, token_mask   int64 and bool [tasks, P]: the prompts by task
    """

    def __init__(
        self, config: ModelConfig, rows: int, tokens: Tensor, token_mask: Tensor, device: torch.device
    ) -> None:
        self.config, self.rows, self.device = config, rows, device
        precision = "bf16" if device.type == "cuda" else "f32"
        with torch.device("meta"):
            shapes = Pi0Model(config).state_dict()
        state = {
            name: torch.zeros(value.shape, dtype=parameter_dtype(name, precision), device=device)  # type: ignore[arg-type]
            for name, value in shapes.items()
        }
        self.model = Pi0Model.from_state(config, state)
        self._all_tokens, self._all_masks = tokens.to(device), token_mask.to(device)
        self.camera_images = torch.zeros(rows, 2, IMAGE_PX, IMAGE_PX, 3, dtype=torch.uint8, device=device)
        self.tokens = self._all_tokens[:1].repeat(rows, 1)
        self.token_mask = self._all_masks[:1].repeat(rows, 1)
        self.noise = torch.zeros(rows, HORIZON, config.action_dim, device=device)
        self.given = torch.zeros(rows, HORIZON, config.action_dim, device=device)
        self.held = torch.zeros(rows, HORIZON, dtype=torch.bool, device=device)
        times = time_embedding(time_grid(NUM_STEPS), config.expert.width)
        self._time_embeddings = times.to(device)
        self._time_zero = time_embedding(np.zeros(1, np.float32), config.expert.width).to(device)
        self._stream: torch.cuda.Stream | None = None
        self._graph: torch.cuda.CUDAGraph | None = None

    def take(self, weights: dict[str, Tensor]) -> None:
        """Copy newer weights in."""
        own = self.model.state_dict()
        names = list(own)
        torch._foreach_copy_([own[name] for name in names], [weights[name].detach() for name in names])
        if self._stream is not None:  # the next chunk is computed on another stream
            self._stream.wait_stream(torch.cuda.current_stream(self.device))

    def capture(self) -> None:
        """On a GPU: record the computation. Before other threads use the GPU."""
        if self.device.type != "cuda":
            return
        self._stream = torch.cuda.Stream(self.device, priority=-1)  # type: ignore[no-untyped-call]
        with torch.cuda.stream(self._stream):
            for _ in range(2):
                self._compute()
        self._stream.synchronize()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, stream=self._stream):
            self._out = self._compute()

    def act(self, camera_images: np.ndarray, prompts: list[int], held: Sequence[np.ndarray] = ()) -> np.ndarray:
        """uint8[n, 2, 224, 224, 3], n <= rows -> normalised actions float32[n, H, action_dim].

        held   for each row the actions [d, <= action_dim], normalised, that its chunk begins with; none: d is 0
        """
        n = len(camera_images)
        given, mask = np.zeros(self.given[:n].shape, np.float32), np.zeros((n, HORIZON), bool)
        for row, actions in enumerate(held):
            given[row, : len(actions), : actions.shape[-1]] = actions
            mask[row, : len(actions)] = True
        with torch.cuda.stream(self._stream), torch.no_grad():
            self.camera_images[:n].copy_(torch.from_numpy(camera_images))
            chosen = torch.tensor(prompts, device=self.device)
            self.tokens[:n] = self._all_tokens[chosen]
            self.token_mask[:n] = self._all_masks[chosen]
            self.given[:n].copy_(torch.from_numpy(given))
            self.held[:n].copy_(torch.from_numpy(mask))
            self.noise.normal_()
            if self._graph is not None:
                self._graph.replay()
                return self._out[:n].cpu().numpy()
            return self._compute()[:n].cpu().numpy()

    def chunks(
        self, scale: Normalizer, camera_images: np.ndarray, prompts: list[int], held: Sequence[np.ndarray]
    ) -> np.ndarray:
        """As `act`, with held actions [d, 7] and chunks float64[n, H, 7] in the robot's units."""
        actions = self.act(camera_images, prompts, [scale.normalize(one) for one in held])
        return scale.unnormalize(actions)[..., :7]

    @torch.no_grad()
    def _compute(self) -> Tensor:
        model, config = self.model, self.config
        images = embed_images(model.vision, model.projector, self.camera_images)[0]
        x = torch.cat((images, embed_prompt(model.vlm, self.tokens)), dim=1)
        cameras = torch.ones(self.rows, images.shape[1], dtype=torch.bool, device=self.device)
        valid = torch.cat((cameras, self.token_mask), dim=1)
        rope = rope_tables(valid.cumsum(1) - 1, config.vlm.head_dim, config.rope_base)
        keys, values = prefix_keys_values(model.vlm, x, rope, valid[:, None, None])
        offsets = torch.arange(HORIZON, device=self.device)
        suffix_rope = rope_tables(valid.sum(1, keepdim=True) + offsets, config.expert.head_dim, config.rope_base)
        suffix = torch.ones(self.rows, HORIZON, dtype=torch.bool, device=self.device)
        mask = torch.cat((valid, suffix), dim=1)[:, None, None]
        conditions, held = model.time_condition(self._time_embeddings), self.held[..., None]
        zero = model.time_condition(self._time_zero)
        x_t = torch.where(held, self.given, self.noise)
        for step in range(NUM_STEPS):
            cond = torch.where(held, zero, conditions[step])  # [rows, H, E]
            y = model.embed_suffix(x_t, x_t, cond)
            out = run_expert(model.expert, y, cond, keys, values, suffix_rope, mask)
            x_t = euler_step(x_t, model.action_out_proj(out.float()), NUM_STEPS)
            x_t = torch.where(held, self.given, x_t)
        return x_t
