"""The options of `--policy.type=turbopi`; whatever else LeRobot asks a policy's config is read from the checkpoint."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from draccus.utils import DecodingError
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_policy_turbopi.real_time import MODES
from lerobot_policy_turbopi.server import PROCESSORS, connect
from turbopi.support.errors import CheckpointError, ConfigError

KINDS = ("pi05", "pi0", "smolvla", "pi0_fast")
SERVERS = {  # options that a server decides about, and what they are when they aren't given
    "checkpoint": None,
    "backend": "auto",
    "precision": "bf16",
    "quantization": None,
    "num_inference_steps": None,
    "warmup": True,
}
NO_TRAINING = (
    "Turbo-Pi runs policies, it doesn't train them: train with --policy.type=pi05, for one, and run the "
    "checkpoint with --policy.type=turbopi --policy.checkpoint=…"
)


_OTHER_NAMES = {  # of the checkpoint's config
    ("smolvla", "num_inference_steps"): "num_steps",
    ("pi0_fast", "num_inference_steps"): "max_decoding_steps",
}


@PreTrainedConfig.register_subclass("turbopi")
@dataclass
class TurboPiConfig(PreTrainedConfig):
    """How Turbo-Pi runs a LeRobot checkpoint of type pi05, pi0, smolvla or pi0_fast.

    checkpoint           its folder, or its name on the Hugging Face hub (owner/name, with `pretrained_revision`)
    server               in place of a checkpoint: ws://HOST:PORT, a `turbopi serve CHECKPOINT` that computes for this
                         robot. It decides about backend, precision and steps. Its key: the variable TURBOPI_API_KEY
    backend              a name from `turbopi doctor`; "auto" takes the fastest one available
    precision            "bf16", "f32", or with a calibration "fp8", "int8", … (docs/quantization.md)
    quantization         what `turbopi calibrate` wrote for this checkpoint; None: the turbopi_fp8.json or
                         turbopi_int8.json in its folder
    num_inference_steps  denoising steps a chunk, of pi0_fast tokens of an answer at most; None: the checkpoint's
    n_action_steps       actions of a chunk that are executed before the next one; None: the checkpoint's, of a server
                         all of the chunk
    rtc_mode             with `--inference.type=rtc`: "guided" as LeRobot computes it, or "trained", which holds the
                         first actions: for checkpoints with rtc_training_max_delay. LeRobot's main branch takes
                         `--inference.rtc.mode=trained` for its own pi05 alone
    warmup               compile and capture everything when the policy is made, not during the first calls

    The fields of PreTrainedConfig are as in LeRobot: `device` says where it runs. The features are the checkpoint's,
    unless they are given, and so are

    chunk_size, max_action_dim  the model's action chunk [H, D]
    rtc_training_max_delay      the longest delay, in control steps, that training simulated; 0: none
    image_resolution            (height, width) that images are resized to
    action_feature_names        of the robot's actions, in the model's order, if the checkpoint has them

    Raises CheckpointError if the checkpoint is of another type, and ConfigError for options that don't fit it.
    """

    checkpoint: str | None = None
    server: str | None = None
    backend: str = "auto"
    precision: str = "bf16"
    quantization: str | None = None
    num_inference_steps: int | None = None
    n_action_steps: int | None = None
    rtc_mode: str = "guided"
    warmup: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rtc_mode not in MODES:
            raise ConfigError(f"rtc_mode is {self.rtc_mode!r}; choose one of {', '.join(MODES)}")
        self.rtc_config: Any = None  # LeRobot sets it for --inference.type=rtc
        if self.checkpoint is None and self.server is None:
            return  # LeRobot also makes configs that it never runs; the policy refuses it
        described = self._described() if self.server is None else self._served()
        self.chunk_size: int = described.chunk_size
        self.max_action_dim: int = described.max_action_dim
        self.image_resolution: tuple[int, int] = _resolution(described)
        self.action_feature_names: list[str] | None = getattr(described, "action_feature_names", None)
        self.rtc_training_max_delay: int = getattr(described, "rtc_training_max_delay", 0)
        for name in ("input_features", "output_features", "num_inference_steps", "n_action_steps"):
            if getattr(self, name) in (None, {}):
                setattr(self, name, getattr(described, _OTHER_NAMES.get((described.type, name), name)))
        if not self.pretrained_path:  # where LeRobot looks for the processors
            self.pretrained_path: Path | None = Path(self.checkpoint) if self.checkpoint else PROCESSORS
        if self.n_action_steps is None or not 1 <= self.n_action_steps <= self.chunk_size:
            raise ConfigError(
                f"n_action_steps is {self.n_action_steps}; it should be from 1 to the chunk's {self.chunk_size} actions"
            )

    def _described(self) -> Any:
        """The checkpoint's own config."""
        import lerobot.policies  # noqa: F401 - registers pi05 and the others

        try:
            described = PreTrainedConfig.from_pretrained(self.checkpoint, revision=self.pretrained_revision)
        except DecodingError as error:
            raise CheckpointError(
                f"the installed LeRobot can't read the config.json of {self.checkpoint} ({error}). If a newer one "
                "saved it, install that, or run `turbopi serve` on the checkpoint and give --policy.server here"
            ) from error
        if described.type not in KINDS:
            raise CheckpointError(
                f"{self.checkpoint} is a LeRobot checkpoint of type {described.type!r}; Turbo-Pi runs "
                f"{' and '.join(map(repr, KINDS))}"
            )
        described.validate_features()  # adds the empty cameras, and features that the file leaves to defaults
        return described

    def _served(self) -> Any:
        """What the server says of its policy, in the names of a checkpoint's config."""
        for name, default in SERVERS.items():
            if getattr(self, name) != default:
                raise ConfigError(
                    f"{name} is {getattr(self, name)!r}, and server {self.server!r}: the server decides about it, so "
                    "give it to `turbopi serve` and leave it out here"
                )
        with connect(cast(str, self.server)) as client:
            metadata = client.metadata
        images = {key: PolicyFeature(type=FeatureType.VISUAL, shape=(3, 224, 224)) for key in metadata["robot_cameras"]}
        state = PolicyFeature(type=FeatureType.STATE, shape=(metadata["robot_state_dim"],))
        return SimpleNamespace(
            type="turbopi",
            chunk_size=metadata["action_horizon"],
            max_action_dim=metadata["robot_action_dim"],
            image_resolution=(224, 224),
            action_feature_names=metadata.get("robot_action_names"),
            rtc_training_max_delay=metadata["real_time"]["trained_max_delay"],
            input_features={**images, "observation.state": state},
            output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(metadata["robot_action_dim"],))},
            num_inference_steps=None,
            n_action_steps=metadata["action_horizon"],
        )

    # what LeRobot's training asks

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> Any:
        raise NotImplementedError(NO_TRAINING)

    def get_scheduler_preset(self) -> Any:
        raise NotImplementedError(NO_TRAINING)

    def validate_features(self) -> None:
        """The checkpoint's features are valid already."""


def _resolution(described: Any) -> tuple[int, int]:
    """(height, width) that the images of a checkpoint are resized to."""
    if described.type == "smolvla":
        width, height = described.resize_imgs_with_padding
        return height, width
    return tuple(described.image_resolution)
