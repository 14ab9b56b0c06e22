"""The keys of a LeRobot config.json of Pi0.5 or Pi0, and what each value does here.

    read        LeRobotFolder reads and checks it
    harmless    changes no action here, whatever it is: about training, the hub, devices, or what a caller decides
    neutral     computes something else unless it has one of these values: others are refused by the key's name

Any other key is noted with its value: another program may compute something from it.
Source: `PreTrainedConfig`, `PI05Config`, `PI0Config`, `RTCConfig` of LeRobot 0.4.0 to 0.6.1 and of its main branch in
August 2026 (7427f31), field by field.
"""

from collections.abc import Mapping

from turbopi.checkpoint.lerobot_versions import FIRST_KEYS
from turbopi.support.reading import shown

# key: (the values that Turbo-Pi computes, what that is)
NEUTRAL: Mapping[str, tuple[tuple[object, ...], str]] = {
    "image_resolution": (([224, 224],), "224 x 224 images"),
    "min_period": ((4e-3,), "the time embedding's shortest period 0.004"),
    "max_period": ((4.0,), "the time embedding's longest period 4.0"),
    # MEM: neither its images nor, without proprioception, its weights differ from an ordinary policy's
    "use_visual_memory": ((False,), "policies that see the current images alone"),
    "use_proprioceptive_memory": ((False,), "policies that read the current state alone"),
}
READ = {
    *("type", "input_features", "output_features", "use_peft", "paligemma_variant", "action_expert_variant", "dtype"),
    *("chunk_size", "max_state_dim", "max_action_dim", "num_inference_steps", "empty_cameras", "tokenizer_max_length"),
    *("normalization_mapping", "use_relative_actions", "action_feature_names", "rtc_config", "rtc_training_max_delay"),
}
HARMLESS = (FIRST_KEYS - READ - NEUTRAL.keys()) | {
    *("freeze_vision_encoder", "train_expert_only", "optimizer_fused", "pretrained_revision"),
    "relative_exclude_joints",  # the preprocessor's own list decides
    *("memory_frames", "memory_stride", "memory_temporal_attention_every"),  # of memory, which is refused
}
# of rtc_config
RTC_READ = {"enabled", "mode", "prefix_attention_schedule", "max_guidance_weight", "execution_horizon"}
RTC_HARMLESS = {"debug", "debug_maxlen"}


def refused(config: Mapping[str, object]) -> tuple[str, str] | None:
    """The first key whose value computes something else, and what Turbo-Pi computes."""
    for key, (values, meaning) in NEUTRAL.items():
        if key in config and config[key] not in values:
            return key, meaning
    return None


def unknown(config: Mapping[str, object]) -> list[str]:
    """`key = value` of each key that isn't in the table."""
    odd = {key: config[key] for key in sorted(config.keys() - READ - HARMLESS - NEUTRAL.keys())}
    rtc = config.get("rtc_config")
    if isinstance(rtc, Mapping):
        odd |= {f"rtc_config.{key}": rtc[key] for key in sorted(rtc.keys() - RTC_READ - RTC_HARMLESS)}
    return [f"{key} = {shown(value)}" for key, value in odd.items()]
