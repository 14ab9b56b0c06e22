"""LoRA adapters of the peft library, as LeRobot's fine-tunes keep them: merged into their base model's weights.

`adapter_config.json` says how, `adapter_model.safetensors` holds, below `base_model.model.`, what was trained:

    ….lora_A.weight [r, in], ….lora_B.weight [out, r]                  w + s * B @ A
    ….lora_A.weight [r, in, h, w], ….lora_B.weight [out, r, 1, 1]      the same, of a convolution flattened
    ….lora_embedding_A [r, rows], ….lora_embedding_B [width, r]        w + s * (B @ A).T
    any other name (modules_to_save, bias)                             in the place of the base's tensor

with s = alpha / r, or alpha / sqrt(r) if rank-stabilised. `rank_pattern` and `alpha_pattern` have other values for the
modules whose name, or its end behind a dot, their keys match as regular expressions; the first one counts.
`fan_in_fan_out` says nothing about layers that store [out, in], as all of these do. The merge is done in float32. What
changes the computation in other ways (DoRA, ...) is refused by name. Source: peft 0.21's `LoraModel`, `get_pattern_key`
and `get_peft_model_state_dict`; LeRobot's `make_policy` and `save_checkpoint` (0.6.1).
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from math import sqrt
from pathlib import Path

import torch
from torch import Tensor

from turbopi.checkpoint.names import EMBEDDING, TIED_HEAD, current_name
from turbopi.checkpoint.source import Piece, listing
from turbopi.checkpoint.torch_files import ITEMSIZE, Stored, TorchSource, read_header, read_tensor
from turbopi.checkpoint.torch_files import WEIGHTS as MODEL
from turbopi.support.errors import CheckpointError
from turbopi.support.reading import Fields, read_json, shown

CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
_PREFIX = "base_model.model."
_PAIRS = {".lora_A.weight": ".lora_B.weight", ".lora_embedding_A": ".lora_embedding_B"}
_READ = ("peft_type", "r", "lora_alpha", "use_rslora", "rank_pattern", "alpha_pattern", "init_lora_weights")
# about training, or about which modules have adapters, which the tensors tell
_NO_MATTER = {
    *("auto_mapping", "base_model_name_or_path", "bias", "ensure_weight_tying", "eva_config", "exclude_modules"),
    *("fan_in_fan_out", "inference_mode", "layers_pattern", "layers_to_transform", "lora_dropout", "megatron_core"),
    *("modules_to_save", "peft_version", "qalora_group_size", "revision", "runtime_config", "target_modules"),
    *("task_type", "loftq_config"),
}
_REPEATS, _REPEATED_GROUP = re.compile(r"[*+?{]"), re.compile(r"\)[*+?{]")  # a hostile one matches for hours
_ADVICE = "Merge it in LeRobot's environment (peft's merge_and_unload), save the whole policy, and give that folder"


@dataclass(frozen=True)
class _Pair:
    """The adapter of one weight: w + scale * (left @ right), by the tensors that they are made of."""

    a: Stored
    b: Stored
    embedding: bool
    scale: float

    def factors(self) -> tuple[Tensor, Tensor]:
        """float32 [rows of w, r] and [r, the rest of w]."""
        a, b = read_tensor(self.a).float(), read_tensor(self.b).float()
        return (a.T * self.scale, b.T) if self.embedding else (b.flatten(1) * self.scale, a.flatten(1))


class PeftSource:
    """A base model's weights with the adapter in `folder` merged in.

    Raises CheckpointError for an adapter that isn't complete, doesn't fit the base, or isn't of a kind that is merged.
    """

    format = "lerobot"
    vision_heads: int | None = None

    def __init__(self, folder: Path, base: TorchSource, base_folder: Path) -> None:
        self._base = base
        self._where = folder / WEIGHTS
        config = folder / CONFIG
        self._scales = _Scales(Fields(read_json(config), config))
        self._pairs: dict[str, _Pair] = {}
        self._replaced: dict[str, Stored] = {}
        self._sort(read_header(self._where))
        self.shapes, self.untied = base.shapes, base.untied
        self.dtypes = base.dtypes | dict.fromkeys(self._pairs, "F32")
        self.dtypes |= {name: stored.dtype for name, stored in self._replaced.items()}
        self.files = [*base.files, config, self._where]
        merged = f"LoRA adapters of {len(self._pairs)} weights are merged into the weights of {base_folder}"
        others = f"; {len(self._replaced)} tensors come from the adapter whole" if self._replaced else ""
        self.notes = [*base.notes, merged + others]
        self.random = base.random

    def native_name(self, name: str) -> str:
        return self._base.native_name(name)

    def pieces(self, device: torch.device) -> Iterator[Piece]:
        for name, pieces in groupby(self._base.pieces(device), key=lambda piece: piece.name):
            if name in self._replaced:
                whole = read_tensor(self._replaced[name])
                for piece in pieces:
                    yield Piece(name, piece.start, whole[piece.start : piece.start + len(piece.values)])
            elif name in self._pairs:
                left, right = self._pairs[name].factors()
                for piece in pieces:
                    rows = left[piece.start : piece.start + len(piece.values)]
                    yield Piece(name, piece.start, (rows @ right).view(piece.values.shape).add_(piece.values.float()))
            else:
                yield from pieces

    def _sort(self, tensors: list[Stored]) -> None:
        """Pairs and replacements by the canonical name of the weight that they are for."""
        by_key = {stored.key.removeprefix(_PREFIX).removeprefix("model."): stored for stored in tensors}
        strange = [stored.key for stored in by_key.values() if not stored.key.startswith(_PREFIX)]
        strange += [stored.key for stored in by_key.values() if stored.dtype not in ITEMSIZE]
        if strange or len(by_key) < len(tensors):
            raise CheckpointError(
                f"{self._where} holds {listing(strange or [stored.key for stored in tensors])}; expected float32, "
                f"bfloat16 and float16 tensors, each once, below {_PREFIX}"
            )
        for first, second in _PAIRS.items():
            for key in [key for key in by_key if key.endswith((first, second))]:
                if key in by_key:  # not yet taken with its other half
                    module = key.removesuffix(first).removesuffix(second)
                    self._add_pair(module, by_key.pop(module + first, None), by_key.pop(module + second, None))
        for key, stored in by_key.items():
            if ".lora_" in key:
                raise CheckpointError(f"{self._where}: {stored.key} isn't merged by Turbo-Pi. {_ADVICE}")
            plain = key.replace(".base_layer.", ".").replace(".modules_to_save.", ".")
            if name := self._target(plain, stored):
                self._check_new(name, stored)
                self._replaced[name] = stored
                if stored.shape != self._base.shapes[name]:
                    self._refuse_shapes(name, stored)

    def _add_pair(self, module: str, a: Stored | None, b: Stored | None) -> None:
        if a is None or b is None:
            raise CheckpointError(
                f"{self._where} is incomplete: the adapter of {module} has one of its two matrices; copy it anew"
            )
        name = self._target(f"{module}.weight", a)
        if not name:
            return
        self._check_new(name, a)
        w, embedding = self._base.shapes[name], a.key.endswith("_A")
        rank = a.shape[0] if a.shape else 0
        if embedding:
            fits = (a.shape, b.shape) == ((rank, w[0]), (w[-1], rank)) and len(w) == 2
        else:
            ones = (1,) * (len(w) - 2)
            fits = len(w) > 1 and (a.shape, b.shape) == ((rank, *w[1:]), (w[0], rank, *ones))
        if not fits:
            self._refuse_shapes(name, a, b)
        self._pairs[name] = _Pair(a, b, embedding, self._scales.of("model." + module, rank))

    def _target(self, key: str, stored: Stored) -> str:
        """The canonical name of the parameter at `key`; "" for heads, which no action is computed from."""
        names, shapes = self._base.names, self._base.shapes
        head = getattr(names, "head", None)
        name = head if current_name(key) == TIED_HEAD else names.canonical(key)
        if name is None:
            return ""
        alone = name != EMBEDDING or head is None or head in shapes  # else the base's table is its head, too
        if head is not None and ((name == head and head not in shapes) or not alone):
            raise CheckpointError(
                f"{self._where}: {stored.key} is for one of lm_head and embed_tokens, and the base model has one table "
                f"for both. {_ADVICE}"
            )
        if name not in shapes:
            raise CheckpointError(
                f"{self._where}: {stored.key} is for {key}, which the base model doesn't have; is it the model that "
                "the adapter was trained on?"
            )
        return name

    def _check_new(self, name: str, stored: Stored) -> None:
        if name in self._pairs or name in self._replaced:
            raise CheckpointError(f"{self._where}: {stored.key} is the second change of {self.native_name(name)}")

    def _refuse_shapes(self, name: str, *tensors: Stored) -> None:
        shapes = " and ".join(f"{stored.key} {list(stored.shape)}" for stored in tensors)
        raise CheckpointError(
            f"{self._where}: {shapes} doesn't fit {self.native_name(name)} {list(self._base.shapes[name])} of the base "
            "model; is it the model that the adapter was trained on?"
        )


class _Scales:
    """What adapter_config.json says of the products' factors. CheckpointError for what isn't plain LoRA."""

    def __init__(self, config: Fields) -> None:
        self._config = config
        kind = config.text("peft_type")
        if kind != "LORA":
            raise CheckpointError(f"{config.where}: peft_type is {shown(kind)}; Turbo-Pi merges LORA. {_ADVICE}")
        start = config.values.get("init_lora_weights", True)
        odd = {key: value for key, value in config.values.items() if value and key not in {*_READ, *_NO_MATTER}}
        if not _leaves_base(start):
            odd["init_lora_weights"] = start
        if odd:
            requested = ", ".join(f"{key} = {shown(value)}" for key, value in odd.items())
            raise CheckpointError(f"{config.where} asks for {requested}, which Turbo-Pi doesn't merge. {_ADVICE}")
        self._rank, self._alpha = config.integer("r", 1, 2**20), config.number("lora_alpha", 0.0)
        self._stabilised = config.flag("use_rslora", False)
        self._ranks, self._alphas = self._pattern("rank_pattern"), self._pattern("alpha_pattern")

    def of(self, module: str, rank: int) -> float:
        """The factor for a module whose adapter has `rank` rows."""
        expected = _matched(self._ranks, module, self._rank)
        if rank != expected or not rank:
            raise CheckpointError(
                f"the adapter of {module} has rank {rank}, but {self._config.where} says {expected:g}; one of the "
                "files belongs to another adapter"
            )
        alpha = _matched(self._alphas, module, self._alpha)
        return alpha / sqrt(rank) if self._stabilised else alpha / rank

    def _pattern(self, key: str) -> dict[re.Pattern[str], float]:
        if self._config.values.get(key) is None:
            return {}
        values, found = self._config.object(key), {}
        for pattern in values.values:
            if len(pattern) > 300 or len(_REPEATS.findall(pattern)) > 3 or _REPEATED_GROUP.search(pattern):
                raise CheckpointError(
                    f"{self._config.where}: {key} has {shown(pattern)}, which may take for ever to match. At most "
                    f"three repetitions (* + ? {{}}), and none of a group, are read. {_ADVICE}"
                )
            try:
                found[re.compile(rf"(.*\.)?({pattern})$")] = values.number(pattern, 0.0)
            except re.error as error:
                raise CheckpointError(f"{self._config.where}: {key} has {shown(pattern)}: {error}") from error
        return found


def _leaves_base(start: object) -> bool:
    """Whether an init_lora_weights sets A and B alone, read as by peft, which ignores the case of "gaussian" and takes
    null for false; others (PiSSA, LoftQ, ...) change the base's weights, too.
    """
    if isinstance(start, str) and start.lower() == "gaussian":
        return True
    return not start or start is True or start in ("eva", "orthogonal")


def _matched(patterns: Mapping[re.Pattern[str], float], module: str, default: float) -> float:
    return next((value for pattern, value in patterns.items() if pattern.match(module)), default)


def is_adapter(folder: Path) -> bool:
    """Whether LeRobot would run an adapter here: config.json says so, or there are no other weights."""
    if not (folder / CONFIG).is_file():
        return False
    return read_json(folder / "config.json").get("use_peft") is True or not (folder / MODEL).exists()


def base_model(folder: Path, given: str | None) -> Path:
    """The folder of the base model of the adapter in `folder`: `given`, else what the adapter names if that is one.

    Raises CheckpointError, saying what to give, if there is none.
    """
    config = Fields(read_json(folder / CONFIG), folder / CONFIG)
    named = config.values.get("base_model_name_or_path")
    if given is not None:
        return Path(given)
    if isinstance(named, str) and named:
        for place in (Path(named).expanduser(), folder / named):  # relative to here, as LeRobot does, or to the adapter
            if place.is_dir():
                return place
    what = f"names its base model {shown(named)}, which is no folder here" if named else "names no base model"
    fetch = f" (hf download {named} --local-dir DIR)" if re.fullmatch(r"[\w.-]+/[\w.-]+", str(named or "")) else ""
    raise CheckpointError(
        f"{folder} holds an adapter without its base model: {config.where} {what}. Put its folder{fetch} into a "
        f'turbopi.json there: {{"base_model": "/path/to/it"}}. Or merge: {_ADVICE[0].lower()}{_ADVICE[1:]}'
    )
