"""LeRobot's `smolvla` checkpoints: config.json, the processors, and the vision-language model's own config.json.

LeRobot's config.json holds no sizes of the vision-language model: it names a repository, whose config is in the Hub's
cache. It is read from the folder that turbopi.json names as `vlm`, from the checkpoint, from the Hub's cache, or, of
published models, from what is known of them. The tensors must fit what it says.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

from turbopi.checkpoint import lerobot_versions as versions
from turbopi.checkpoint import lerobot_vlm as vlm_config
from turbopi.checkpoint.lerobot import CONFIG, USE_LEROBOT, LeRobotFolder
from turbopi.checkpoint.lerobot_keys import SMOLVLA, Keys
from turbopi.checkpoint.lerobot_pipeline import ACTION, POSTPROCESSOR, PREPROCESSOR, STATE, TOKENIZER
from turbopi.checkpoint.names import Names
from turbopi.checkpoint.source import WeightSource
from turbopi.checkpoint.vision_positions import SHIFTED, ShiftedPositions
from turbopi.config import LIMITS, Network, Normalization, PolicyConfig, TimeRounding
from turbopi.models import Family
from turbopi.models.smolvla.config import PUBLISHED, SmolVLAConfig, from_lerobot
from turbopi.models.smolvla.names import canonical_name, native_name
from turbopi.models.smolvla.positions import position_rows
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.hub_cache import hub_folder
from turbopi.support.reading import Fields, read_json, shown

_VLM = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
_COUNTS = {  # keys, and the limits of turbopi.config for them
    "chunk_size": "action_horizon",
    "tokenizer_max_length": "max_prompt_tokens",
    "max_state_dim": "action_dim",
    "max_action_dim": "action_dim",
}
ALOHA_JOINTS = 14
_TOKENIZER, _TOKENIZER_CONFIG = "tokenizer.json", "tokenizer_config.json"


@dataclass(frozen=True)
class SummedTimes(SmolVLAConfig):
    """Of LeRobot 0.4.0 to 0.4.2."""

    time_grid: ClassVar[TimeRounding] = "accumulated"


class SmolVLANames:
    """LeRobot's names. depth: text layers that the network uses; files hold more of them."""

    def __init__(self, depth: int) -> None:
        self._depth = depth

    def canonical(self, key: str) -> str | None:
        return canonical_name(key, self._depth)

    def native(self, name: str) -> str:
        return native_name(name)


class SmolVLAFolder(LeRobotFolder):
    """As `LeRobotFolder`. vlm_source: where the vision-language model's sizes are from, for messages."""

    keys: ClassVar[Keys] = SMOLVLA
    own_settings: ClassVar[frozenset[str]] = frozenset({"vlm", "vision_positions"})
    sizes_hint: ClassVar[str] = (
        "The sizes are those of the vision-language model that config.json names (vlm_model_name). If the policy was "
        'trained with another, put its folder into a turbopi.json there: {"vlm": "/path/to/it"}'
    )

    @classmethod
    def names(cls, folder: Path) -> Names:
        config = Fields(read_json(folder / CONFIG), folder / CONFIG)
        depth = config.integer("num_vlm_layers", -LIMITS["depth"], LIMITS["depth"], default=16)
        return SmolVLANames(depth if depth > 0 else LIMITS["depth"])

    def _described(self) -> PolicyConfig:
        return PolicyConfig(
            name="lerobot_smolvla",
            model=self._network(),
            robot="lerobot",
            normalization=self.normalization,
            robot_options=self._robot_options(),
            turns_aloha=self._turns_aloha(),
            discrete_state_input=False,
            image_resize="lerobot_smolvla",
            prompt_as_is=True,
            num_denoising_steps=self._steps("num_steps"),
            real_time=self._real_time(),
        )

    def _turns_aloha(self) -> bool:
        turns = self.config.flag("adapt_to_pi_aloha", False)
        if turns and min(self.state_dim, self.action_dim) < ALOHA_JOINTS:
            raise CheckpointError(
                f"{self.file} has adapt_to_pi_aloha = true, for {ALOHA_JOINTS} joints and grippers, but the state has "
                f"{self.state_dim} values and an action {self.action_dim}; LeRobot can't run it either"
            )
        return turns

    def notes(self) -> list[str]:
        notes = super().notes()
        if self.settings.policy is None:
            notes += [
                f"{file} has no statistics of {what}, though it scales them by {mode}: LeRobot leaves them as they "
                "are, and so does Turbo-Pi. Fine-tune the policy, or take a checkpoint with this robot's statistics"
                for file, what, mode, stats in (
                    (PREPROCESSOR, STATE, self._claimed("STATE"), self.stats.state),
                    (POSTPROCESSOR, ACTION, self._claimed("ACTION"), self.stats.actions),
                )
                if stats is None and mode != "IDENTITY"
            ]
        return notes

    @property
    def normalization(self) -> Normalization:
        """What isn't there scales nothing, as in LeRobot; `notes` says so."""
        found = super().normalization
        if "normalization" in self.settings.values:
            return found
        return Normalization(
            "identity" if self.stats.state is None else found.state,
            "identity" if self.stats.actions is None else found.actions,
        )

    @property
    def vlm_name(self) -> str:
        return self.config.text("vlm_model_name", _VLM)

    @property
    def named_tokenizer(self) -> Path | None:
        """The processors'; where that isn't here and is the vision-language model's, a turbopi.json's "vlm" has it."""
        named, own = super().named_tokenizer, self.settings.values.get("vlm")
        step = self.pipelines.steps[TOKENIZER].config
        if own and not (named and (named / _TOKENIZER).is_file()) and step.text("tokenizer_name", "") == self.vlm_name:
            return Path(own)
        return named

    def _claimed(self, kind: str) -> str:
        return str(self.config.object("normalization_mapping", {}).values.get(kind, "IDENTITY"))

    def _notes_on_version(self) -> list[str]:
        """The rounding of t aside, LeRobot's versions differ by the transformers that they ran with."""
        unsure = versions.may_have_shifted_positions(self.config.values)
        if not unsure or "vision_positions" in self.settings.values or self.config.flag("load_vlm_weights", False):
            return []
        return [
            "positions of image patches are LeRobot 0.5's and later. LeRobot 0.4 with transformers 4.55 to 4.57 took "
            "them one row and one column too early in a float32 vision tower such as this one, and no file tells "
            'whether it did: {"vision_positions": "shifted"} in a turbopi.json computes that, "exact" what is computed '
            "now"
        ]

    def _check_family(self, family: Family) -> None:
        size = self.config.values.get("resize_imgs_with_padding", [512, 512])
        square = isinstance(size, list) and len(size) == 2 and size[0] == size[1] and isinstance(size[0], int)
        if not square or not 1 <= size[0] <= LIMITS["image_size"]:
            raise CheckpointError(
                f"{self.file} has resize_imgs_with_padding = {shown(size)}; Turbo-Pi reads a square size, such as "
                "[512, 512]"
            )
        given = self.config.values.keys()
        for key in given & _COUNTS.keys():
            self.config.integer(key, 1, LIMITS[_COUNTS[key]])
        for key in given & {"num_vlm_layers", "num_expert_layers", "prefix_length", "self_attn_every_n_layers"}:
            self.config.integer(key, -1, LIMITS["max_prompt_tokens"])
        for key in given & {"min_period", "max_period", "expert_width_multiplier"}:
            self.config.number(key, 1e-6, 1e6)
        for key in ("load_vlm_weights", "add_image_special_tokens"):
            self.config.flag(key, False)
        self.config.text("attention_mode", "cross_attn")

    def _network(self) -> SmolVLAConfig:
        found, source = self._vlm()
        try:
            vlm, other = vlm_config.completed(found), vlm_config.refused(found)
            depth = _depth(self.config.values, vlm["text_config"])
            chosen = {"num_vlm_layers": depth, "tokenizer_max_length": self.pipelines.max_tokens}
            network = from_lerobot({**self.config.values, **chosen}, {**vlm, **self._special_tokens()})
        except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
            raise CheckpointError(
                f"{source} isn't a config of a SmolVLM: {type(error).__name__} at {error}; expected its "
                "text_config and vision_config with their sizes"
            ) from error
        if other is not None:
            raise CheckpointError(f"{source} has {other}. {USE_LEROBOT}")
        if (problem := _problem(network)) is not None:
            raise CheckpointError(f"{self.file} with the sizes of {source}: {problem}; LeRobot can't run it either")
        if versions.smolvla_sums_up_time(self.config.values) and self.settings.values.get("lerobot_semantics") != "0.6":
            return SummedTimes(**{one.name: getattr(network, one.name) for one in fields(network)})
        return network

    def weights(self, source: WeightSource, network: Network) -> WeightSource:
        if self.settings.values.get("vision_positions") != SHIFTED or not isinstance(network, SmolVLAConfig):
            return source
        if network.element_types.vision == "bfloat16":
            raise ConfigError(
                f"{self.settings.source}: vision_positions is {SHIFTED!r}, but {self.file} has load_vlm_weights = "
                "true: in a bfloat16 vision tower no version of transformers shifted them"
            )
        table, patches = (size // network.vision.patch_size for size in (network.vision.image_size, network.image_size))
        if position_rows(patches, table, "float32").tolist() != [i * table // patches for i in range(patches)]:
            raise ConfigError(
                f"{self.settings.source}: vision_positions is {SHIFTED!r}, which isn't computed for {patches} patches "
                f"a side and a table of {table}, whose quotients aren't exact"
            )
        return ShiftedPositions(source, table, patches, self.settings.source)

    def _vlm(self) -> tuple[Mapping[str, Any], str]:
        """The vision-language model's config, and where it is from."""
        for folder in self._vlm_folders():
            if (file := folder / "config.json").is_file() and "text_config" in (found := read_json(file)):
                return Fields(found, file).values, str(file)
        if self.vlm_name in PUBLISHED:
            return PUBLISHED[self.vlm_name], f"what is known of {self.vlm_name}"
        raise CheckpointError(
            f"{self.file} names the vision-language model {shown(self.vlm_name)}, whose config.json holds the sizes, "
            f"and it isn't in the Hub's cache. Fetch it (hf download {self.vlm_name} config.json tokenizer.json "
            'tokenizer_config.json), or put its folder into a turbopi.json: {"vlm": "/path/to/it"}'
        )

    def _vlm_folders(self) -> list[Path]:
        own = self.settings.values.get("vlm")
        named = [Path(own)] if own else [self.folder / self.vlm_name, Path(self.vlm_name)]
        cached = hub_folder(self.vlm_name)
        return [*named, *([] if own or cached is None else [cached])]

    def _special_tokens(self) -> dict[str, tuple[int, ...]]:
        """Ids of the tokens around images, which LeRobot asks the model's own tokenizer for; {}: the published ones."""
        if not self.config.flag("add_image_special_tokens", False):
            return {}
        for folder in self._vlm_folders():
            if not (folder / _TOKENIZER).is_file() or not (folder / _TOKENIZER_CONFIG).is_file():
                continue
            words = Fields(read_json(folder / _TOKENIZER_CONFIG), folder / _TOKENIZER_CONFIG)
            around, whole = (
                words.text(key, default)
                for key, default in (
                    ("fake_image_token", "<fake_token_around_image>"),
                    ("global_image_token", "<global-img>"),
                )
            )
            added = read_json(folder / _TOKENIZER, limit=64 * 2**20).get("added_tokens") or []
            ids = {one.get("content"): one.get("id") for one in added if isinstance(one, dict)}
            first, second = ids.get(around), ids.get(whole)
            if not (isinstance(first, int) and isinstance(second, int)):
                raise CheckpointError(f"{folder / _TOKENIZER} has no tokens {around} and {whole} among added_tokens")
            return {"image_start_token_ids": (first, second), "image_end_token_ids": (first,)}
        return {}


def _depth(config: Mapping[str, Any], text: Mapping[str, Any]) -> int:
    """Text layers that the network has: all that there are where LeRobot's number is 0 or less, never more."""
    depth: int = config.get("num_vlm_layers", 16)
    there: int = text["num_hidden_layers"]
    return min(depth, there) if depth > 0 else there


def _problem(network: SmolVLAConfig) -> str | None:
    """What doesn't fit together, if anything."""
    vision, text = network.vision, network.text
    for name, value in (
        *(
            (f"vision {key}", getattr(vision, key))
            for key in ("width", "depth", "mlp_dim", "num_heads", "image_size", "patch_size")
        ),
        *((f"text {key}", getattr(text, key)) for key in ("width", "mlp_dim", "num_heads", "num_kv_heads", "head_dim")),
    ):
        if not isinstance(value, int) or value < 1:
            return f"{name} is {shown(value)}"
    if not vision.patch_size <= vision.image_size <= LIMITS["image_size"]:
        return f"vision image_size is {vision.image_size}, of patches of {vision.patch_size}"
    side, factor = network.image_size // vision.patch_size, network.scale_factor
    if side < factor or side % factor:
        return f"{side} patches a side, of {network.image_size} pixels, aren't a multiple of {factor}"
    if network.expert_width % 2:
        return f"the expert is {network.expert_width} wide, and the time embedding needs an even number"
    if vision.width % vision.num_heads or text.num_heads % text.num_kv_heads or text.head_dim % 2:
        return "heads don't divide the widths"
    if network.expert_depth < 1 or text.depth % network.expert_depth:
        return f"{network.expert_depth} layers of the expert don't go into {text.depth} text layers"
    return None
