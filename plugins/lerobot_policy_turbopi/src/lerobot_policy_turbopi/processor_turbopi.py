"""The checkpoint's own processors: LeRobot normalises, tokenises and un-normalises as with its own policy."""

from typing import Any

from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_turbopi.configuration_turbopi import TurboPiConfig
from turbopi.support.errors import ConfigError


def make_turbopi_pre_post_processors(
    config: TurboPiConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[Any, Any]:
    """LeRobot calls this by its name, where nobody names a folder of processors.

    `dataset_stats` isn't read: the weights were trained with the checkpoint's.
    """
    if config.checkpoint is None:
        raise ConfigError("no checkpoint: --policy.type=turbopi needs --policy.checkpoint=…")
    device = {"device_processor": {"device": config.device}}
    return make_pre_post_processors(
        config,
        pretrained_path=config.checkpoint,
        pretrained_revision=config.pretrained_revision,
        preprocessor_overrides=device,
    )
