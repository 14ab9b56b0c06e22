"""Pi0.5 and Pi0 as families. Their reference is one, reference.py; Pi0.5 with memory adds memory.py to it."""

from dataclasses import replace

from turbopi.models.family import Family
from turbopi.models.pi0.memory import MemoryModel
from turbopi.models.pi0.reference import Pi0Model, parameter_dtype
from turbopi.models.pi0.sites import linears
from turbopi.quantization.plan import TIERS

PI05 = Family(
    "pi05",
    "Pi0.5",
    Pi0Model,
    lambda name, precision, _: parameter_dtype(name, precision),
    modulated=True,
    state_token=False,
    marks=("time_mlp_in", "time_mlp_", "expert.norm.dense."),
    state_step="pi05_prepare_state_tokenizer_processor_step",
    prompt_tokens=200,
    linears=linears,
    tiers=TIERS,
)
PI05_VISUAL_MEMORY = replace(PI05, label="Pi0.5 with memory", reference=MemoryModel, planned=False, tiers=())
PI05_STATE_MEMORY = replace(PI05_VISUAL_MEMORY, state_in_prefix=True)
PI0 = Family(
    "pi0",
    "Pi0",
    Pi0Model,
    lambda name, precision, _: parameter_dtype(name, precision),
    modulated=False,
    state_token=True,
    marks=("state_proj", "action_time_mlp_"),
    state_step=None,
    prompt_tokens=48,
    linears=linears,
    tiers=TIERS,
)
