"""SmolVLA as a family."""

from turbopi.config import Normalization, PolicyConfig
from turbopi.models.family import Family
from turbopi.models.smolvla.config import ElementTypes, SmolVLAConfig
from turbopi.models.smolvla.names import parameter_dtype
from turbopi.models.smolvla.reference import SmolVLAModel
from turbopi.models.smolvla.sites import linears
from turbopi.models.smolvla.work import counts

BASE = PolicyConfig(  # as lerobot/smolvla_base, but for the robot: for random weights
    "smolvla_base",
    SmolVLAConfig(element_types=ElementTypes("bfloat16", "bfloat16")),
    "plain",
    Normalization("lerobot_zscore", "lerobot_zscore"),
    discrete_state_input=False,
    image_resize="lerobot_smolvla",
    prompt_as_is=True,
)
SMOLVLA = Family(
    "smolvla",
    "SmolVLA",
    SmolVLAModel,
    parameter_dtype,
    modulated=False,
    state_token=False,
    marks=("vlm_with_expert.",),  # LeRobot's own: its config.json tells the family before any weight is read
    state_step=None,
    prompt_tokens=48,
    planned=False,
    state_in_prefix=True,
    paligemma=False,
    counts=counts,
    linears=linears,
    tiers=("fp8", "fp8-mlp", "int8"),
)
