"""The keys of a LeRobot config.json, by type of policy, and what each value does here.

    read        LeRobotFolder reads and checks it
    harmless    changes no action here, whatever it is: about training, the hub, devices, or what a caller decides
    neutral     computes something else unless it has one of these values: others are refused by the key's name

Any other key is noted with its value: another program may compute something from it.
Source: `PreTrainedConfig`, `PI05Config`, `PI0Config`, `SmolVLAConfig`, `RTCConfig` of LeRobot 0.4.0 to 0.6.1 and of its
main branch in August 2026 (7427f31), field by field; of `PI052Config` in its open PR 4184 (f2c8867).
"""

from collections.abc import Mapping
from dataclasses import dataclass

from turbopi.checkpoint.lerobot_versions import FIRST_KEYS
from turbopi.support.reading import shown

# of rtc_config
RTC_READ = {"enabled", "mode", "prefix_attention_schedule", "max_guidance_weight", "execution_horizon"}
RTC_HARMLESS = {"debug", "debug_maxlen"}


@dataclass(frozen=True)
class Keys:
    """Of one type of policy. neutral: key -> (the values that Turbo-Pi computes, what that is)."""

    read: frozenset[str]
    harmless: frozenset[str]
    neutral: Mapping[str, tuple[tuple[object, ...], str]]

    def refused(self, config: Mapping[str, object]) -> tuple[str, str] | None:
        """The first key whose value computes something else, and what Turbo-Pi computes."""
        for key, (values, meaning) in self.neutral.items():
            if key in config and config[key] not in values:
                return key, meaning
        return None

    def unknown(self, config: Mapping[str, object]) -> list[str]:
        """`key = value` of each key that isn't in the table."""
        known = self.read | self.harmless | self.neutral.keys()
        odd = {key: config[key] for key in sorted(config.keys() - known)}
        rtc = config.get("rtc_config")
        if isinstance(rtc, Mapping):
            odd |= {f"rtc_config.{key}": rtc[key] for key in sorted(rtc.keys() - RTC_READ - RTC_HARMLESS)}
        return [f"{key} = {shown(value)}" for key, value in odd.items()]


_PERIODS: Mapping[str, tuple[tuple[object, ...], str]] = {
    "min_period": ((4e-3,), "the time embedding's shortest period 0.004"),
    "max_period": ((4.0,), "the time embedding's longest period 4.0"),
}
_OF_PI_NEUTRAL: Mapping[str, tuple[tuple[object, ...], str]] = {
    "image_resolution": (([224, 224],), "224 x 224 images"),
    **_PERIODS,
}
_OF_ALL = {
    *("type", "input_features", "output_features", "use_peft", "chunk_size", "max_state_dim", "max_action_dim"),
    *("empty_cameras", "tokenizer_max_length", "normalization_mapping", "rtc_config"),
}
_OF_PI = _OF_ALL | {
    *("paligemma_variant", "action_expert_variant", "dtype", "num_inference_steps", "use_relative_actions"),
    *("action_feature_names", "rtc_training_max_delay"),
    # MEM, of pi05: neither its images nor, without proprioception, its weights differ from an ordinary policy's
    *("use_visual_memory", "use_proprioceptive_memory"),
    *("memory_frames", "memory_stride", "memory_temporal_attention_every"),
}
_TRAINING = {"freeze_vision_encoder", "train_expert_only", "optimizer_fused", "pretrained_revision"}
PI = Keys(
    frozenset(_OF_PI),
    frozenset(
        (FIRST_KEYS - _OF_PI - _OF_PI_NEUTRAL.keys())
        | _TRAINING
        | {"relative_exclude_joints"}  # the preprocessor's own list decides
    ),
    _OF_PI_NEUTRAL,
)
PI052 = Keys(
    frozenset(
        _OF_PI
        | {"n_action_steps", "subtask_replan_steps", "joint_subtask_conditioning", "fast_skip_tokens"}
        | {"text_loss_weight", "unfreeze_lm_head"}
    ),
    frozenset(
        PI.harmless
        | {
            *("recipe_path", "flow_loss_weight", "plan_dropout_prob", "memory_dropout_prob", "subtask_dropout_prob"),
            *("enable_fast_action_loss", "action_tokenizer_name", "max_action_tokens", "fast_action_loss_weight"),
            *("auto_fit_fast_tokenizer", "fast_tokenizer_cache_dir", "fast_tokenizer_fit_samples"),
            *("fast_tokenizer_validation_samples", "fast_tokenizer_max_reconstruction_rmse"),
            *("fast_tokenizer_max_dim_rmse", "knowledge_insulation", "flow_num_repeats", "text_ce_z_loss_weight"),
            *("use_flashrt_adarms", "use_compiled_text_ce", "use_compiled_vision", "use_flex_attention"),
            *("use_manual_attention", "manual_attention_scope", "use_flashrt_fp8_mlp"),  # ways to compute the same
            *("lm_head_lr_scale", "backbone_lr_scale", "action_expert_lr_scale", "optimizer_foreach"),
        }
    ),
    {
        **_OF_PI_NEUTRAL,
        "apply_chat_template": ((False,), "prompts as `User: …`"),
        "memory_scratchpad": ((False, None), "subtasks without a written memory"),
    },
)
PI0_FAST = Keys(
    frozenset(
        (_OF_PI - {"num_inference_steps", "rtc_training_max_delay"})
        | {
            *("max_decoding_steps", "fast_skip_tokens", "validate_action_token_prefix", "action_tokenizer_name"),
            *("n_action_steps", "text_tokenizer_name"),
        }
    ),
    frozenset(
        ((FIRST_KEYS - _OF_PI - _OF_PI_NEUTRAL.keys()) | _TRAINING)
        | {"relative_exclude_joints", "max_action_tokens", "use_kv_cache"}  # without keys and values: as slow as exact
    ),
    {
        "image_resolution": _OF_PI_NEUTRAL["image_resolution"],
        "temperature": ((0, None), "greedy decoding, temperature 0"),
    },
)
SMOLVLA = Keys(
    frozenset(
        _OF_ALL
        | {
            *("resize_imgs_with_padding", "num_steps", "vlm_model_name", "load_vlm_weights", "attention_mode"),
            *("add_image_special_tokens", "prefix_length", "num_expert_layers", "num_vlm_layers"),
            *("self_attn_every_n_layers", "expert_width_multiplier", "min_period", "max_period", "adapt_to_pi_aloha"),
        }
    ),
    frozenset(
        _TRAINING
        | {
            *("n_obs_steps", "device", "use_amp", "push_to_hub", "repo_id", "private", "tags", "license"),
            *("pretrained_path", "n_action_steps", "train_state_proj", "compile_model", "compile_mode"),
            *("optimizer_lr", "optimizer_betas", "optimizer_eps", "optimizer_weight_decay"),
            *("optimizer_grad_clip_norm", "scheduler_warmup_steps", "scheduler_decay_steps", "scheduler_decay_lr"),
            "pad_language_to",  # masked tokens change nothing
        }
    ),
    {
        "use_delta_joint_actions_aloha": ((False,), "absolute actions (LeRobot itself refuses it)"),
        "use_cache": ((True,), "keys and values of the prefix once a call (LeRobot itself can't do without)"),
    },
)
