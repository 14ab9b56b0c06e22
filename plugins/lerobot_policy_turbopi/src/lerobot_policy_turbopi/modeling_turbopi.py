"""LeRobot's policy interface over Turbo-Pi's model: preprocessed batch in, normalised action chunk out.

LeRobot's processors stand before and behind it, as with LeRobot's own Pi0.5. Of Turbo-Pi the model alone runs: what
`PI05Policy.predict_action_chunk` does between the processors is done here, with LeRobot's own resizing.
"""

import logging
import re
import shutil
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn, cast

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor
from torch.nn.functional import pad

from lerobot_policy_turbopi import real_time
from lerobot_policy_turbopi.configuration_turbopi import NO_TRAINING, TurboPiConfig
from lerobot_policy_turbopi.real_time import Join, read_join
from lerobot_policy_turbopi.server import PROCESSORS, ServedModel
from turbopi import UnifiedPolicy, open_checkpoint
from turbopi.config import empty_cameras, memory_of
from turbopi.models import family_of
from turbopi.models.observation import ModelInputs, Observation
from turbopi.policy.call_options import checked_steps
from turbopi.policy.history import ObservationHistory
from turbopi.preprocess.images import fit_unit
from turbopi.robots.aloha import smolvla_actions, smolvla_state
from turbopi.support.errors import ActionError, CheckpointError, ConfigError, ObservationError
from turbopi.support.reading import file_inside, read_json

logger = logging.getLogger(__name__)


class TurboPiPolicy(PreTrainedPolicy):
    """A LeRobot checkpoint of one of the types KINDS on Turbo-Pi's fastest backend. It has no parameters of PyTorch.

    turbopi   the policy that runs the model; None: made from `config`. Its robot, statistics and tokenizer aren't used

    With a server in `config` the model runs there: what is called a batch is then the robot's, what is called
    normalised are the robot's actions, and LeRobot's processors change nothing.

    Raises what `turbopi.UnifiedPolicy` and `turbopi.realtime.RealTimeClient` raise, and ConfigError without a
    checkpoint.
    """

    config_class = TurboPiConfig
    name = "turbopi"

    def __init__(self, config: TurboPiConfig, turbopi: UnifiedPolicy | None = None, **unused: Any) -> None:
        super().__init__(config)  # unused: LeRobot hands statistics of data sets to every policy
        self.config = config
        self.served = ServedModel(config.server) if config.server is not None else None
        self.turbopi = load(config) if turbopi is None and self.served is None else turbopi
        self._actions: deque[Tensor] = deque()
        self._histories: list[ObservationHistory] = []  # of each row, with memory
        self.eval()

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        revision: str | None = None,
        **unused: Any,
    ) -> "TurboPiPolicy":
        """A policy from a checkpoint that Turbo-Pi runs, or from what `save_pretrained` left, with its options."""
        if config is None:
            config = PreTrainedConfig.from_pretrained(pretrained_name_or_path, revision=revision)
        if not isinstance(config, TurboPiConfig):
            config = TurboPiConfig(checkpoint=str(pretrained_name_or_path), pretrained_revision=revision)
        return cls(config)

    def supports_rtc(self) -> bool:
        """Whether `--inference.type=rtc` runs it: LeRobot's main branch calls this."""
        return self.served is not None or not _writes_tokens(self._local)

    def init_rtc_processor(self) -> None:
        """LeRobot calls it once `config.rtc_config` is set, before the robot is connected.

        Raises ConfigError if this policy can't join chunks in the config's mode. Warms up the calls that do.
        """
        if not real_time.enabled(self.config.rtc_config):
            return
        mode = real_time.mode_of(self.config)
        offered = self.served.modes if self.served is not None else self._local.metadata["real_time"]["modes"]
        if mode not in offered:
            where = f"the server at {self.config.server}" if self.served is not None else "this backend"
            raise ConfigError(
                f"rtc_mode {self.config.rtc_mode!r} needs the way to join chunks {mode!r}, and {where} has "
                f"{', '.join(offered) or 'none'}. Use backend 'fused', 'cuda_graph' or 'pytorch', or "
                "--inference.type=sync"
            )
        if self.served is not None:
            self.served.warm_up(mode)
        elif self.config.warmup:
            self._local.warmup(horizons=self.config.chunk_size, real_time=mode)

    @torch.compiler.disable  # Turbo-Pi compiles for itself
    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        noise: Tensor | None = None,
        num_steps: int | None = None,
        *,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        execution_horizon: int | None = None,
    ) -> Tensor:
        """A preprocessed batch to normalised actions float32[B, chunk_size, actions], on the batch's device.

        noise      float32[B, chunk_size, max_action_dim]; None: drawn as LeRobot's own policy draws it, so that the
                   same seed of PyTorch gives the same noise
        num_steps  denoising steps; None: the config's num_inference_steps

        With RTC (`config.rtc_config` set and enabled), as LeRobot's own pi05 and pi0 take them:

        prev_chunk_left_over  float32[K, actions] or [B, K, actions]: what is left of the last answer when the
                              observation is taken; None: nothing is joined
        inference_delay       how many of these are carried out before the answer arrives; more than can be joined are
                              cut to that, with a warning
        execution_horizon     of this call; None: the rtc_config's

        Raises ObservationError for a batch without images or tokens, noise of another shape and for steps, left-overs
        and delays that can't be; ActionError for actions that aren't finite.
        """
        if self.served is None:
            inputs = self._inputs(batch)
            join = read_join(self.config, inputs.batch_size, prev_chunk_left_over, inference_delay, execution_horizon)
            return self._computed(inputs, noise, num_steps, join, batch[OBS_LANGUAGE_TOKENS].device)
        if noise is not None or num_steps is not None:
            raise ObservationError("noise and num_steps were given, but the server decides about both: leave them out")
        if OBS_STATE not in batch:
            raise ObservationError(f"the batch has no {OBS_STATE!r}; it has {', '.join(batch)}")
        state = batch[OBS_STATE]
        join = read_join(self.config, len(state), prev_chunk_left_over, inference_delay, execution_horizon)
        return self.served.chunk(batch, len(state), join).to(state.device)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **options: Any) -> Tensor:
        """One action [B, actions]: the next of the chunk, or the first one of a new one once n_action_steps are used.

        `options` are `predict_action_chunk`'s. Raises ConfigError with RTC, whose chunks LeRobot joins itself.
        """
        if real_time.enabled(self.config.rtc_config):
            raise ConfigError(
                "select_action and RTC don't go together: call predict_action_chunk, as LeRobot's engine does"
            )
        if not self._actions:
            chunk = self.predict_action_chunk(batch, **options)[:, : self.config.n_action_steps]
            self._actions.extend(chunk.transpose(0, 1))
        elif self.served is not None:
            self.served.observe(batch)
        elif memory_of(self._local.config.model) is not None:
            self._inputs(batch)  # which records it
        return self._actions.popleft()

    def reset(self) -> None:
        """Forget the rest of the chunk, and what a policy with memory has seen: a new episode."""
        self._actions.clear()
        self._histories.clear()
        if self.served is not None:
            self.served.reset()

    def drop_queued_actions(self) -> None:
        """The same. LeRobot after 0.6.1 calls it within an episode, when the task changes; no other state is kept."""
        self._actions.clear()

    def forward(self, batch: dict[str, Tensor], **unused: Any) -> NoReturn:
        raise NotImplementedError(NO_TRAINING)

    def get_optim_params(self) -> NoReturn:
        raise NotImplementedError(NO_TRAINING)

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """The options, the processors and what lies beside them, for --policy.path; the weights stay where they are."""
        folder, config = PROCESSORS, self.config
        if config.checkpoint is not None:
            folder = local_folder(config)
            if Path(config.checkpoint).is_dir():
                config = replace(config, checkpoint=str(folder.absolute()))
        config._save_pretrained(save_directory)
        for file in folder.glob("policy_*processor*"):
            shutil.copy(file, save_directory)
            for artifact in _artifacts(file) if file.suffix == ".json" else ():
                source, target = (file_inside(where, artifact, file) for where in (folder, save_directory))
                if source.is_dir():
                    shutil.copytree(source, target, dirs_exist_ok=True)
                else:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(source, target)

    # -- a batch in the model's words ----------------------------------------------------------------------------------

    @property
    def _local(self) -> UnifiedPolicy:
        assert self.turbopi is not None
        return self.turbopi

    def _computed(
        self, inputs: Observation, noise: Tensor | None, num_steps: int | None, join: Join | None, device: torch.device
    ) -> Tensor:
        shape = (inputs.batch_size, self.config.chunk_size, self.config.max_action_dim)
        if noise is None and _writes_tokens(self._local):  # nothing of them is drawn
            noise = torch.zeros(shape, device=device)
        elif noise is None:
            noise = torch.normal(mean=0.0, std=1.0, size=shape, dtype=torch.float32, device=device)
        if noise.shape != shape:
            raise ObservationError(f"noise has shape {list(noise.shape)}, but this policy needs {list(shape)}")
        steps = checked_steps(
            cast(int, self.config.num_inference_steps) if num_steps is None else num_steps, ObservationError
        )
        joined: dict[str, Any] = {}
        if join is not None:
            joined["conditioning"] = [join.conditioning(row, steps, *shape[1:]) for row in range(shape[0])]
        with torch.inference_mode(False):  # buffers made inside it would be of no use outside
            actions = self._local.backend.sample(inputs, noise, steps, **joined).actions
        if self._local.config.turns_aloha:
            actions = torch.from_numpy(smolvla_actions(actions.cpu().numpy()))
        if not actions.isfinite().all():
            raise ActionError("the model computed actions that aren't finite; `turbopi verify` compares backends")
        return actions[..., : self.config.output_features[ACTION].shape[0]].to(device)

    def _inputs(self, batch: dict[str, Tensor]) -> Observation:
        for key in (OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK):
            if key not in batch:
                raise ObservationError(f"the batch has no {key!r}; it has {', '.join(batch)}. Preprocess it first")
        tokens, camera_images = batch[OBS_LANGUAGE_TOKENS], self._images(batch)
        # What is missing isn't sent at all, but for images that have tokens around them
        mask = torch.ones(camera_images.shape[:2], dtype=torch.bool)
        masked = min(len(self.config.image_features) - mask.shape[1], empty_cameras(self._local.config.model))
        inputs = Observation(
            images=pad(camera_images, (0,) * 7 + (masked,)),
            image_mask=pad(mask, (0, masked)),
            tokens=tokens,
            token_mask=batch[OBS_LANGUAGE_ATTENTION_MASK].bool(),
            state=self._state(batch, len(tokens)),
        )
        if memory_of(self._local.config.model) is None:
            return inputs
        return self._with_past(inputs, [key for key in self.config.image_features if key in batch])

    def _with_past(self, inputs: Observation, cameras: Sequence[str]) -> Observation:
        """The same, on the host, recorded in each row's history, with what came before. As LeRobot: an entry a call."""
        host = inputs.to("cpu")
        each = (host.images, host.image_mask, host.tokens, host.token_mask, host.state)
        rows = [ModelInputs(*arrays) for arrays in zip(*(part.numpy() for part in each), strict=True)]
        if not self._histories:
            made = [self._local.new_history() for _ in rows]
            self._histories = [one for one in made if isinstance(one, ObservationHistory)]
        if len(rows) != len(self._histories):
            raise ObservationError(
                f"the batch has {len(rows)} rows, and those before it {len(self._histories)}: a policy with memory "
                "keeps a history of each, so call reset() first"
            )
        for row, history in zip(rows, self._histories, strict=True):
            history.record(cameras, row)
        return Observation.stack(
            [history.with_past(cameras, row) for row, history in zip(rows, self._histories, strict=True)]
        )

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        """float32[B, C, height, width, 3] in [-1, 1] of the cameras that the batch has, in the checkpoint's order."""
        present = [key for key in self.config.image_features if key in batch]
        if not present:
            wanted = ", ".join(self.config.image_features)
            raise ObservationError(
                f"the batch has none of the checkpoint's cameras, {wanted}; it has {', '.join(batch)}"
            )
        size, model = self.config.image_resolution, self._local.config.model
        camera_images = []
        for key in present:
            if batch[key].ndim != 4:
                raise ObservationError(
                    f"{key} has shape {list(batch[key].shape)}; it should be [B, 3, h, w], the current frame: a policy "
                    "with memory keeps those before it"
                )
            camera_image = batch[key].to(torch.float32)
            if camera_image.shape[1] == 3:
                camera_image = camera_image.permute(0, 2, 3, 1)
            if camera_image.shape[1:3] == size:
                camera_images.append(camera_image * 2 - 1)
            elif family_of(model).paligemma:
                camera_images.append(resize_with_pad_torch(camera_image, *size) * 2 - 1)
            else:
                camera_images.append(fit_unit(camera_image, size, self._local.config.image_resize))
        return torch.stack(camera_images, dim=1)

    def _state(self, batch: dict[str, Tensor], rows: int) -> Tensor:
        """float32[B, state_dim], padded, of a family that reads it as numbers. Pi0.5 has it in the prompt."""
        model = self._local.config.model
        family = family_of(model)
        state = torch.zeros(rows, self.config.max_action_dim if family.planned else model.state_dim)
        if family.reads_state:
            given = batch[OBS_STATE]
            if self._local.config.turns_aloha:
                given = torch.from_numpy(smolvla_state(given.cpu().numpy()))
            state[:, : given.shape[-1]] = given
        return state


def _writes_tokens(policy: UnifiedPolicy) -> bool:
    return family_of(policy.config.model).reader is not None


class _Words:
    """A tokenizer of no model: one id for each word."""

    def encode(self, text: str, *, add_bos: bool) -> list[int]:
        return list(range(1, 1 + len(text.split())))


def load(config: TurboPiConfig) -> UnifiedPolicy:
    """Turbo-Pi's policy for a config, warm if it says so."""
    if config.checkpoint is None:
        raise ConfigError(
            "no checkpoint: --policy.type=turbopi needs --policy.checkpoint=FOLDER, or a hub's owner/name"
        )
    checkpoint = open_checkpoint(local_folder(config))
    ours = checkpoint.config
    family, tokenizer = family_of(ours.model), checkpoint.named_tokenizer
    if family.paligemma:  # the edges are those of the LeRobot that runs, and so is its time grid
        ours = replace(ours, image_resize="lerobot")
    if family.paligemma and family.reader is None:
        ours = ours.with_model(time_grid="multiplied")
    policy = UnifiedPolicy(
        replace(checkpoint, config=ours, named_tokenizer=None if family.reader is None else tokenizer),
        backend=config.backend,
        precision=cast(Any, config.precision),
        quantization=config.quantization,
        num_denoising_steps=config.num_inference_steps,
        device=config.device or "auto",
        # LeRobot's processors tokenise; with this one warm-up alone reads a prompt, and answers are read
        tokenizer=_Words() if family.reader is None else None,
    )
    described = policy.metadata
    logger.info(
        "Turbo-Pi runs %s: backend %s (%s)", config.checkpoint, described["backend"], described["backend_reason"]
    )
    if config.warmup:
        seconds = policy.warmup(horizons=config.chunk_size)
        logger.info("warm after %.1f s", seconds)
    return policy


def _artifacts(processors: Path) -> list[str]:
    """What processors name beside their file, the tokenizer's folder for one: LeRobot declares it after 0.6.1."""
    steps = read_json(processors).get("steps") or []
    return [str(name) for step in steps for name in step.get("artifacts", {}).values()]


def local_folder(config: TurboPiConfig) -> Path:
    """The checkpoint's folder, downloaded if it is a name on the hub. CheckpointError if it is neither."""
    checkpoint = cast(str, config.checkpoint)
    if Path(checkpoint).is_dir():
        return Path(checkpoint)
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", checkpoint):
        raise CheckpointError(f"{checkpoint!r} is neither a folder nor a name on the hub (owner/name)")
    from huggingface_hub import snapshot_download

    return Path(snapshot_download(checkpoint, revision=config.pretrained_revision))
