"""LeRobot's Pi0 and Pi0.5 with small layers, and its tokenizer step with the small tokenizer that Turbo-Pi ships.

LeRobot fixes every size in its code. Only the sizes are replaced here: all that computes is LeRobot's.
"""

import math
import zlib
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi05 import modeling_pi05
from lerobot.processor import tokenizer_processor
from sentencepiece import SentencePieceProcessor

from lerobot_cases import tokenizer_folder

TOKENIZER = Path(__file__).parents[2] / "src" / "turbopi" / "data" / "small_policy" / "tokenizer.model"
VISION = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
VISION_HEADS = VISION["num_attention_heads"]
VOCABULARY = 1024
DEPTH, HEADS, HEAD_DIM = 2, 8, 8
WIDTHS = {"gemma_2b": (24, 40), "gemma_300m": (16, 24)}  # (width, mlp_dim)


def shrink(*more: ModuleType) -> None:
    """Let LeRobot make small models from now on, and tokenise without its hub. more: modules of other models."""
    for module in (modeling_pi0, modeling_pi05, *more):
        _shrink(module)
    tokenizer_processor.AutoTokenizer = _SmallTokenizer


def fill(parameters: Iterable[tuple[str, torch.nn.Parameter]], seed: int) -> None:
    """Seeded weights of few bits, so that they compress well; each depends on its name alone."""
    with torch.no_grad():
        for name, parameter in parameters:
            generator = torch.Generator().manual_seed(seed * 2**32 + zlib.crc32(name.encode()))
            values = torch.randint(-7, 8, parameter.shape, generator=generator).float()
            matrix = parameter.ndim > 1
            fan_in = 4 if "embed_tokens" in name or "position_embedding" in name else math.prod(parameter.shape[1:])
            values *= 2.0 ** round(math.log2(1 / (4 * math.sqrt(fan_in)))) if matrix else 1 / 64
            is_layer_norm = "vision_tower" in name and "norm" in name and name.endswith("weight")
            parameter.copy_(values + 1 if is_layer_norm else values)


class _SmallTokenizer:
    """What TokenizerProcessorStep calls of a Hugging Face tokenizer, over a SentencePiece model."""

    def __init__(self) -> None:
        self._processor = SentencePieceProcessor(model_file=str(TOKENIZER))

    @classmethod
    def from_pretrained(cls, name: str, **_: Any) -> "_SmallTokenizer":
        assert "paligemma" in name or Path(name).is_dir(), name
        return cls()

    def save_pretrained(self, folder: Path) -> None:
        """LeRobot saves the tokenizer beside the processors after 0.6.1."""
        tokenizer_folder.write(folder)

    def __call__(
        self,
        texts: list[str],
        *,
        max_length: int,
        truncation: bool,
        padding: str,
        padding_side: str,
        return_tensors: str,
    ) -> dict[str, torch.Tensor]:
        assert (padding, padding_side, return_tensors) == ("max_length", "right", "pt")
        ids = torch.zeros(len(texts), max_length, dtype=torch.int64)
        mask = torch.zeros_like(ids)
        for row, text in enumerate(texts):
            encoded = self._processor.encode(text, add_bos=True)
            assert truncation or len(encoded) <= max_length
            encoded = encoded[:max_length]
            ids[row, : len(encoded)] = torch.tensor(encoded)
            mask[row, : len(encoded)] = 1
        return {"input_ids": ids, "attention_mask": mask}


def _shrink(module: ModuleType) -> None:
    paligemma = module.PaliGemmaForConditionalGenerationWithPiGemma
    expert: Any = getattr(module, "PiGemmaForCausalLM", None)  # Pi0-FAST has none

    def sizes(variant: str) -> Any:
        width, mlp_dim = WIDTHS[variant]
        return module.GemmaConfig(
            width=width, depth=DEPTH, mlp_dim=mlp_dim, num_heads=HEADS, num_kv_heads=1, head_dim=HEAD_DIM
        )

    def small_paligemma(config: Any) -> Any:
        for key, value in VISION.items():
            setattr(config.vision_config, key, value)
        config.vision_config.projection_dim = config.text_config.hidden_size
        config.text_config.vocab_size = VOCABULARY
        return paligemma(config=config)

    def small_expert(config: Any) -> Any:
        config.vocab_size = VOCABULARY
        return expert(config=config)

    module.get_gemma_config = sizes  # type: ignore[attr-defined]
    module.PaliGemmaForConditionalGenerationWithPiGemma = small_paligemma  # type: ignore[attr-defined]
    module.PiGemmaForCausalLM = small_expert  # type: ignore[attr-defined]
