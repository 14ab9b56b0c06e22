"""What a policy is made of: the sizes of its model, and what no checkpoint records about its robot.

`ModelConfig` is the network; `PolicyConfig` adds the edges (robot, statistics, prompt). Sizes are read from a
checkpoint's tensors when it is loaded, so a preset's sizes only matter for random weights and for what shapes can't
tell (vision heads of a non-standard width, the horizon). Sources: openpi's `gemma.py`, `siglip.py` and `config.py`.

Every size has a limit, LIMITS: a number beyond it is damage or a slip, and believing it would cost gigabytes.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, get_args

from turbopi.support.errors import ConfigError
from turbopi.support.reading import is_finite, is_integer, shown

PiKind = Literal["pi05", "pi0"]
Kind = Literal["pi05", "pi0", "pi0_fast", "smolvla"]
WITH_MEMORY: tuple[Kind, ...] = ("pi05",)  # LeRobot has `MemoryConfig` in it alone
WITH_TEXT: tuple[Kind, ...] = ("pi05",)  # what may have `TextConfig`
FloatPrecision = Literal["bf16", "f32"]
NormMode = Literal[
    "quantile", "zscore", "lerobot_quantile", "lerobot_quantile10", "lerobot_zscore", "lerobot_min_max", "identity"
]

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")  # openpi's order; prefix tokens follow it

LIMITS = {  # the largest value of each whole number; the smallest is 1. Pi0.5 and Pi0 stay far below
    "action_horizon": 1000,
    "action_dim": 1024,
    "max_prompt_tokens": 8192,
    "max_decoding_steps": 1000,
    "num_denoising_steps": 1000,
    "vocab_size": 2**24,
    "depth": 256,
    "width": 2**16,
    "mlp_dim": 2**20,
    "num_heads": 1024,
    "num_kv_heads": 1024,
    "head_dim": 4096,
    "patch_size": 1024,
    "image_size": 4096,
    "frames": 64,
    "stride": 2048,
    "temporal_every": 256,
    "state_dim": 1024,
}
MOST_GUIDANCE = 100.0  # scale of guidance by a prompt's tag; 1.5 to 2.5 are in use
MOST_REMEMBERED = 2048  # observations of an episode that a policy with memory keeps: 1.2 GB for each camera


ImageResize = Literal["openpi", "lerobot", "lerobot_0.4", "lerobot_smolvla"]  # how, see preprocess/images.py
MissingCameras = Literal["masked", "black"]  # what the model sees of a camera that an observation lacks
BrokenAnswers = Literal["refuse", "owners", "unread"]
Owner = Literal["openpi", "lerobot"]
Schedule = Literal["exponential", "linear", "ones", "zeros"]  # of guidance's weights: models/pi0/conditioning.py
Solver = Literal[
    "euler", "midpoint", "heun", "ab2", "exponential"
]  # of the flow from noise to actions: models/pi0/solvers.py
GridName = Literal["uniform", "shifted_to_noise", "shifted_to_actions"]
TimeGrid = GridName | Sequence[float]  # or times, strictly falling from 1 to 0
TimeRounding = Literal[
    "accumulated", "multiplied"
]  # of uniform times: openpi adds up t in float32; LeRobot: 1 + k * dt


@dataclass(frozen=True)
class VisionConfig:
    """SigLIP. Defaults: So400m/14 at 224 px."""

    width: int = 1152
    depth: int = 27
    mlp_dim: int = 4304
    num_heads: int = 16
    patch_size: int = 14
    image_size: int = 224
    layer_norm_eps: float = 1e-6

    @property
    def num_tokens(self) -> int:
        return (self.image_size // self.patch_size) ** 2

    @property
    def head_dim(self) -> int:
        return self.width // self.num_heads


@dataclass(frozen=True)
class GemmaConfig:
    """One Gemma stack. PaliGemma and the action expert must agree in depth and in everything about heads."""

    width: int
    mlp_dim: int
    depth: int = 18
    num_heads: int = 8
    num_kv_heads: int = 1
    head_dim: int = 256


@dataclass(frozen=True)
class MemoryConfig:
    """Past observations that a Pi0.5 sees: MEM (arXiv 2603.03596), as LeRobot's main branch has it.

    visual          in every `temporal_every`-th layer of SigLIP each patch attends over its past frames
    proprioceptive  past states, with the current one, are tokens between images and prompt
    frames, stride  so many observations, the current one included, and how many lie from one to the next
    state_dim       width of these states
    """

    visual: bool
    proprioceptive: bool
    frames: int = 6
    stride: int = 30
    temporal_every: int = 4
    state_dim: int = 32

    @property
    def length(self) -> int:
        """Observations from the oldest frame to the current one."""
        return (self.frames - 1) * self.stride + 1


class Network(Protocol):
    """What the edges of a policy ask of a network's sizes, whatever its family. Always a frozen dataclass.

    image_size         pixels of an image's side
    state_dim          numbers of state that it takes
    max_prompt_tokens  longer prompts are cut
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def kind(self) -> Kind: ...
    @property
    def vision(self) -> VisionConfig: ...
    @property
    def image_size(self) -> int: ...
    @property
    def state_dim(self) -> int: ...
    @property
    def action_dim(self) -> int: ...
    @property
    def action_horizon(self) -> int: ...
    @property
    def vocab_size(self) -> int: ...
    @property
    def max_prompt_tokens(self) -> int: ...
    @property
    def time_grid(self) -> TimeRounding: ...


@dataclass(frozen=True)
class ModelConfig:
    """The whole network of a Pi0 or Pi0.5. `action_horizon` shapes no weight: any H runs."""

    kind: PiKind = "pi05"
    expert_inputs: ClassVar[bool] = True  # what `quantization.sites` asks; so is `last_read`
    vision: VisionConfig = VisionConfig()
    vlm: GemmaConfig = GemmaConfig(width=2048, mlp_dim=16384)
    expert: GemmaConfig = GemmaConfig(width=1024, mlp_dim=4096)
    vocab_size: int = 257_152
    action_dim: int = 32
    action_horizon: int = 50
    max_prompt_tokens: int = 200
    rms_norm_eps: float = 1e-6
    rope_base: float = 10_000.0
    time_grid: TimeRounding = "accumulated"
    memory: MemoryConfig | None = None

    @property
    def image_size(self) -> int:
        """Pixels of an image's side, as it enters the network."""
        return self.vision.image_size

    @property
    def state_dim(self) -> int:
        """Numbers of state that the network takes."""
        reads_states = self.memory is not None and self.memory.proprioceptive
        return self.memory.state_dim if self.memory is not None and reads_states else self.action_dim

    @property
    def last_read(self) -> int:
        return self.vlm.depth - 1

    def __post_init__(self) -> None:
        """Raises ConfigError for sizes beyond LIMITS, and for sizes that don't fit each other."""
        if self.kind not in get_args(PiKind):
            raise ConfigError(f"kind is {shown(self.kind)}; expected one of {', '.join(get_args(PiKind))}")
        if self.time_grid not in ("accumulated", "multiplied"):
            raise ConfigError(f"time_grid is {shown(self.time_grid)}; expected 'accumulated' or 'multiplied'")
        for name, part in (("", self), ("vision ", self.vision), ("vlm ", self.vlm), ("expert ", self.expert)):
            _check_sizes(name, part)
        if self.memory is not None:
            _check_sizes("memory ", self.memory)
        for attribute in ("depth", "num_heads", "num_kv_heads", "head_dim"):
            ours, theirs = getattr(self.vlm, attribute), getattr(self.expert, attribute)
            if ours != theirs:
                raise ConfigError(f"vlm and expert share one attention, but {attribute} is {ours} and {theirs}")
        _check_heads(self.vision, self.vlm)
        if self.expert.head_dim % 2 or self.expert.width % 2:
            raise ConfigError("RoPE and the time embedding need an even head_dim and an even expert width")
        if self.memory is not None:
            self._check_memory(self.memory)

    def _check_memory(self, memory: MemoryConfig) -> None:
        if self.kind not in WITH_MEMORY or not (memory.visual or memory.proprioceptive):
            raise ConfigError("memory is visual, proprioceptive or both, and of pi05 alone")
        if memory.length > MOST_REMEMBERED:
            raise ConfigError(
                f"{memory.frames} frames that lie {memory.stride} observations apart need the last {memory.length}; at "
                f"most {MOST_REMEMBERED} are kept"
            )
        if memory.visual and memory.temporal_every > self.vision.depth:
            raise ConfigError(
                f"every {memory.temporal_every}th layer of vision attends over frames, but there are "
                f"{self.vision.depth}: none would"
            )
        if memory.visual and self.vision.width % 2:
            raise ConfigError(f"frame positions need an even vision width, not {self.vision.width}")


def memory_of(model: Network) -> MemoryConfig | None:
    """A network's memory; None if it sees the current observation alone."""
    return model.memory if isinstance(model, ModelConfig) else None


def empty_cameras(model: Network) -> int:
    """Cameras that a network reads tokens around though their images are masked; SmolVLA alone has some."""
    return int(getattr(model, "empty_cameras", 0))


@dataclass(frozen=True)
class Pi0FastConfig:
    """The network of a Pi0-FAST, and how its answers are read.

    owner               whose rules hold: openpi's or LeRobot's
    action_dim          of the robot: an answer has action_horizon * action_dim coefficients
    max_decoding_steps  tokens of an answer at most
    skipped_ids         at the end of the vocabulary, which no action token uses (fast_skip_tokens)
    checks_prefix       LeRobot's validate_action_token_prefix
    tied_head           the embedding table gives the logits, too; LeRobot trains the two apart
    broken_answers      "refuse": an ActionError; "owners": what the owner's own code makes of them; "unread": answers
                        are as long as they may be, and stand-in actions are made of their ids, for measurements
    """

    owner: Owner = "openpi"
    vision: VisionConfig = VisionConfig()
    vlm: GemmaConfig = GemmaConfig(width=2048, mlp_dim=16384)
    vocab_size: int = 257_152
    action_dim: int = 32
    action_horizon: int = 32
    max_prompt_tokens: int = 250
    max_decoding_steps: int = 256
    skipped_ids: int = 128
    checks_prefix: bool = True
    tied_head: bool = True
    broken_answers: BrokenAnswers = "refuse"
    rms_norm_eps: float = 1e-6
    rope_base: float = 10_000.0

    kind: ClassVar[Kind] = "pi0_fast"
    time_grid: ClassVar[TimeRounding] = "multiplied"

    @property
    def image_size(self) -> int:
        return self.vision.image_size

    @property
    def state_dim(self) -> int:
        """The prompt alone has the state, of any width."""
        return self.action_dim

    def __post_init__(self) -> None:
        """Raises ConfigError for sizes beyond LIMITS, and for sizes that don't fit each other."""
        for name, part in (("", self), ("vision ", self.vision), ("vlm ", self.vlm)):
            _check_sizes(name, part)
        _check_heads(self.vision, self.vlm)


def _check_heads(vision: VisionConfig, vlm: GemmaConfig) -> None:
    if vision.width % vision.num_heads:
        raise ConfigError(f"vision width {vision.width} isn't a multiple of {vision.num_heads} heads")
    if vlm.num_heads % vlm.num_kv_heads:
        raise ConfigError(f"{vlm.num_heads} query heads don't divide by {vlm.num_kv_heads} KV heads")


def _check_sizes(name: str, part: ModelConfig | Pi0FastConfig | VisionConfig | GemmaConfig | MemoryConfig) -> None:
    for one in dataclasses.fields(part):
        value, limit = getattr(part, one.name), LIMITS.get(one.name)
        if limit is not None and not (is_integer(value) and 1 <= value <= limit):
            raise ConfigError(f"{name}{one.name} is {shown(value)}; expected a whole number from 1 to {limit}")
        if one.type in (float, "float") and not (is_finite(value) and 0 < value <= 1e9):
            raise ConfigError(f"{name}{one.name} is {shown(value)}; expected a number above 0, at most 1e9")


@dataclass(frozen=True)
class Normalization:
    """How state and actions are scaled; the `lerobot_*` modes differ from openpi's in their epsilons."""

    state: NormMode = "quantile"
    actions: NormMode = "quantile"


@dataclass(frozen=True)
class RealTime:
    """Real-time execution (docs/real_time.md): how weights were trained, and what a call's `previous` leaves out."""

    trained_max_delay: int = 0  # control steps of delay that training simulated (arXiv 2512.05964); 0: it didn't
    execution_horizon: int | None = None  # s, as `RunningChunk`'s
    schedule: Schedule = "exponential"
    max_guidance_weight: float = 5.0  # β of arXiv 2506.07339, which evaluates with 5

    def __post_init__(self) -> None:
        """Raises ConfigError for what can't be."""
        limit = LIMITS["action_horizon"]
        if not (is_integer(self.trained_max_delay) and 0 <= self.trained_max_delay < limit):
            raise ConfigError(f"trained_max_delay is {shown(self.trained_max_delay)}; expected 0 to {limit - 1}")
        s = self.execution_horizon
        if s is not None and not (is_integer(s) and 1 <= s <= limit):
            raise ConfigError(f"execution_horizon is {shown(s)}; expected a whole number from 1 to {limit}, or null")
        if self.schedule not in get_args(Schedule):
            raise ConfigError(f"schedule is {shown(self.schedule)}; expected one of {', '.join(get_args(Schedule))}")
        if not (is_finite(self.max_guidance_weight) and 0 <= self.max_guidance_weight <= 1e6):
            raise ConfigError(f"max_guidance_weight is {shown(self.max_guidance_weight)}; expected 0 to 1e6")


@dataclass(frozen=True)
class Subtasks:
    """A policy that writes what it does next, and acts on that: LeRobot's pi052.

    chunks  of actions that are made of one subtask before the next is written
    joint   actions see the prompt, and behind it the subtask, each token of which sees what is before it; else the
            subtask in place of the prompt
    """

    chunks: int = 1
    joint: bool = False


@dataclass(frozen=True)
class TextConfig:
    """Text that a Pi0.5 writes with its language head, greedily (docs/text.md).

    template     what it continues, with {prompt} and, if it was trained so, {state}: the state's numbers
    max_tokens   of an answer at most
    trained      whether the head was; otherwise nothing is written
    skipped_ids  LeRobot's fast_skip_tokens: action tokens, and locations, are never written. None: any id may be
    subtasks     actions are made of what was written; None: of the prompt
    """

    template: str
    max_tokens: int = 128
    trained: bool = True
    skipped_ids: int | None = None
    subtasks: Subtasks | None = None

    def __post_init__(self) -> None:
        """Raises ConfigError for a template without the prompt, and for a number that can't be."""
        if "{prompt}" not in self.template:
            raise ConfigError(f"the template of text is {shown(self.template)}; expected a text with {{prompt}} in it")
        if not (is_integer(self.max_tokens) and 1 <= self.max_tokens <= LIMITS["max_decoding_steps"]):
            limit = LIMITS["max_decoding_steps"]
            raise ConfigError(f"max_tokens of text is {shown(self.max_tokens)}; expected a whole number, 1 to {limit}")


@dataclass(frozen=True)
class PolicyConfig:
    """A model and its robot: everything `UnifiedPolicy` needs besides weights, statistics and a tokenizer."""

    name: str  # for people and metadata
    model: Network  # the network's sizes, the action horizon, the longest prompt
    robot: str  # "libero", "droid", "aloha", "lerobot", "plain", or a path to a robot's .json
    normalization: Normalization = Normalization()  # how statistics scale state and actions
    discrete_state_input: bool = True  # the state is written into the prompt (Pi0.5 only)
    asset_id: str | None = None  # folder of norm_stats.json below assets/; None: the only one there
    robot_options: Mapping[str, Any] = field(default_factory=dict)  # passed to a built-in robot
    default_prompt: str | None = None  # for observations without one
    image_resize: ImageResize = "openpi"  # how images become 224 x 224: "openpi", "lerobot" or "lerobot_0.4"
    prompt_state_dim: int | None = None  # zeros fill the state up to it in the prompt, as in LeRobot 0.4; None: nothing
    prompt_as_is: bool = False  # without a state, blanks, underscores and newlines stay in the prompt: LeRobot's Pi0
    num_denoising_steps: int = 10  # the default of a call; so are the next two
    solver: Solver = "euler"
    solver_grid: TimeGrid = "uniform"  # where its intervals end. `model.time_grid` is how uniform times are rounded
    one_step: bool = False  # distilled for one denoising step: no other number makes its actions
    real_time: RealTime = RealTime()
    missing_cameras: MissingCameras = "masked"  # "black": seen as black images, as by openpi's Pi0-FAST
    prompt_labels: bool = False  # without a state, it still is "Task: ...;\nAction: ": LeRobot's Pi0.5 trained so
    turns_aloha: bool = False  # normalised joints of ALOHA are turned: LeRobot's SmolVLA with adapt_to_pi_aloha
    text: TextConfig | None = None  # what it writes; None: nothing says that its language head was trained

    @property
    def writes_subtasks(self) -> bool:
        """Whether it writes the subtasks that its actions are made of."""
        return self.text is not None and self.text.trained and self.text.subtasks is not None

    @property
    def planned_model(self) -> ModelConfig:
        """`model`, for what Pi0 and Pi0.5 alone have: engines, conversions, their own plan and roofline.

        Raises ConfigError for other families.
        """
        if not isinstance(self.model, ModelConfig) or self.model.memory is not None:
            what = f"{self.model.kind}{' with memory' if isinstance(self.model, ModelConfig) else ''}"
            raise ConfigError(
                f"{self.name} is a {what} policy, and this is for Pi0 and Pi0.5 alone: there are no "
                f"engines or conversions of a {what} yet. `turbopi infer`, `serve`, `bench`, `verify` "
                "and `inspect` take it, on the backends that docs/support.md names"
            )
        return self.model

    def with_model(self, **changes: Any) -> "PolicyConfig":
        """The same policy with some of its model's fields replaced."""
        return dataclasses.replace(self, model=dataclasses.replace(self.model, **changes))


_PI05 = ModelConfig()
_PI0 = ModelConfig(kind="pi0", max_prompt_tokens=48)
_TINY = ModelConfig(
    vision=VisionConfig(width=128, depth=6, mlp_dim=512, num_heads=4),
    vlm=GemmaConfig(width=192, mlp_dim=512, depth=6, head_dim=32),
    expert=GemmaConfig(width=128, mlp_dim=256, depth=6, head_dim=32),
    vocab_size=1024,
    action_horizon=10,
)
_ZSCORE = Normalization("zscore", "zscore")
_LIBERO_FAST = Pi0FastConfig(action_dim=7, action_horizon=10, max_prompt_tokens=180)


def _model(base: ModelConfig, horizon: int) -> ModelConfig:
    return dataclasses.replace(base, action_horizon=horizon)


# Horizons, assets and options: openpi's training/config.py. pi05_libero keeps the state out of the prompt.
_PRESETS = (
    PolicyConfig("pi05_base", _PI05, "plain"),
    PolicyConfig(
        "pi05_libero",
        _model(_PI05, 10),
        "libero",
        asset_id="physical-intelligence/libero",
        discrete_state_input=False,
    ),
    PolicyConfig("pi05_droid", _model(_PI05, 15), "droid", asset_id="droid"),
    PolicyConfig(
        "pi05_aloha",
        _PI05,
        "aloha",
        asset_id="trossen",
        robot_options={"adapt_to_pi": True, "delta_actions": True},
    ),
    PolicyConfig("pi05_tiny", _TINY, "libero", asset_id="physical-intelligence/libero"),
    PolicyConfig("pi0_base", _PI0, "plain", _ZSCORE, discrete_state_input=False),
    PolicyConfig(
        "pi0_libero",
        _PI0,
        "libero",
        _ZSCORE,
        discrete_state_input=False,
        asset_id="physical-intelligence/libero",
        robot_options={"delta_actions": True},  # unlike pi05_libero, trained on actions relative to the state
    ),
    PolicyConfig("pi0_droid", _model(_PI0, 10), "droid", _ZSCORE, discrete_state_input=False, asset_id="droid"),
    PolicyConfig("pi0_fast_base", Pi0FastConfig(), "plain", missing_cameras="black"),
    PolicyConfig(
        "pi0_fast_libero",
        _LIBERO_FAST,
        "libero",
        asset_id="physical-intelligence/libero",
        robot_options={"delta_actions": True},
        missing_cameras="black",
    ),
    PolicyConfig(
        "pi0_fast_droid",
        Pi0FastConfig(action_dim=8, action_horizon=10),
        "droid",
        asset_id="droid",
        robot_options={"wrist_last": True},
        missing_cameras="black",
    ),
    PolicyConfig(
        "pi0_fast_tiny",
        dataclasses.replace(_LIBERO_FAST, vision=_TINY.vision, vlm=_TINY.vlm, vocab_size=1024, max_decoding_steps=24),
        "libero",
        asset_id="physical-intelligence/libero",
        missing_cameras="black",
    ),
    PolicyConfig(
        "pi0_aloha",
        _PI0,
        "aloha",
        _ZSCORE,
        discrete_state_input=False,
        asset_id="trossen",
        robot_options={"adapt_to_pi": True, "delta_actions": True},
    ),
)
PRESETS: dict[str, PolicyConfig] = {preset.name: preset for preset in _PRESETS}


def typed_grid(text: str | None) -> Any:
    """A `TimeGrid`, or None, as it is typed: a name, which isn't checked, or times with commas between them."""
    if text is None or "," not in text:
        return text
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"time_grid={text!r} isn't times with commas between them, such as 1,0.6,0.3,0") from None


def preset(name: str) -> PolicyConfig:
    """The preset called `name`. Raises ConfigError, listing the choices, if there is none."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]
