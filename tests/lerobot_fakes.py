"""As much of LeRobot as the plugin imports, for tests without it. What the real one does: test_lerobot_plugin.py."""

import importlib
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch

PLUGIN = Path(__file__).parents[1] / "plugins" / "lerobot_policy_turbopi" / "src"


@dataclass
class PreTrainedConfig:
    """A config's fields, and one of another policy read from a folder."""

    types: ClassVar[dict[str, type]] = {}

    device: str | None = "cpu"
    input_features: dict[str, Any] = field(default_factory=dict)
    output_features: dict[str, Any] = field(default_factory=dict)
    pretrained_path: Path | None = None
    pretrained_revision: str | None = None

    def __post_init__(self) -> None: ...

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        return lambda registered: cls.types.setdefault(name, registered)

    @classmethod
    def from_pretrained(cls, folder: str | Path, revision: str | None = None) -> Any:
        described = json.loads((Path(folder) / "config.json").read_text())
        features = {name: _features(described.get(name, {})) for name in ("input_features", "output_features")}
        defaults = {"max_action_dim": 32, "image_resolution": [224, 224], "action_feature_names": None}
        return SimpleNamespace(**{**defaults, **described, **features}, validate_features=lambda: None)

    def _save_pretrained(self, folder: Path) -> None:
        (folder / "config.json").write_text("{}")

    @property
    def image_features(self) -> dict[str, Any]:
        return {key: feature for key, feature in self.input_features.items() if feature.type == "VISUAL"}


class PreTrainedPolicy(torch.nn.Module):
    def __init__(self, config: PreTrainedConfig) -> None:
        super().__init__()


def install(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Put the fakes, and the plugin's folder, where imports find them. Returns the plugin's modeling module."""
    contents: dict[str, dict[str, Any]] = {
        "draccus": {},
        "draccus.utils": {"DecodingError": type("DecodingError", (Exception,), {})},
        "lerobot": {},
        "lerobot.configs": {},
        "lerobot.configs.policies": {"PreTrainedConfig": PreTrainedConfig},
        "lerobot.configs.types": {
            "FeatureType": SimpleNamespace(VISUAL="VISUAL", STATE="STATE", ACTION="ACTION"),
            "PolicyFeature": SimpleNamespace,
        },
        "lerobot.policies": {},
        "lerobot.policies.common": {},
        "lerobot.policies.common.vla_utils": {"resize_with_pad_torch": _refuse},
        "lerobot.policies.pretrained": {"PreTrainedPolicy": PreTrainedPolicy},
        "lerobot.utils": {},
        "lerobot.utils.constants": {
            "ACTION": "action",
            "OBS_STATE": "observation.state",
            "OBS_LANGUAGE_TOKENS": "observation.language.tokens",
            "OBS_LANGUAGE_ATTENTION_MASK": "observation.language.attention_mask",
        },
    }
    for name, content in contents.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    parts = ("real_time", "server", "configuration_turbopi", "modeling_turbopi")
    names = ("lerobot_policy_turbopi", *(f"lerobot_policy_turbopi.{part}" for part in parts))
    for name in names:  # imported anew, and gone with the test
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
        del sys.modules[name]
    monkeypatch.syspath_prepend(PLUGIN)
    return importlib.import_module(names[-1])


def rtc_config(
    schedule: str = "LINEAR", execution_horizon: int = 10, max_guidance_weight: float = 10.0, **more: Any
) -> SimpleNamespace:
    """LeRobot's RTCConfig, as its rollout puts it into a policy's config; the main branch's has a mode, too."""
    return SimpleNamespace(
        enabled=True,
        prefix_attention_schedule=SimpleNamespace(name=schedule),
        execution_horizon=execution_horizon,
        max_guidance_weight=max_guidance_weight,
        **more,
    )


def _features(described: dict[str, Any]) -> dict[str, Any]:
    return {key: SimpleNamespace(type=one["type"], shape=tuple(one["shape"])) for key, one in described.items()}


def _refuse(*_: Any) -> None:
    raise AssertionError("these tests' images have the model's size")
