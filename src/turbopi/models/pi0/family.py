"""Pi0.5 and Pi0 as families. Their reference is one, reference.py."""

from turbopi.models.family import Family
from turbopi.models.pi0.reference import Pi0Model, parameter_dtype

PI05 = Family(
    "pi05",
    "Pi0.5",
    Pi0Model,
    lambda name, precision, _: parameter_dtype(name, precision),
    modulated=True,
    state_token=False,
    marks=("time_mlp_in", "time_mlp_", "expert.norm.dense."),
    state_in_prompt=True,
    prompt_tokens=200,
)
PI0 = Family(
    "pi0",
    "Pi0",
    Pi0Model,
    lambda name, precision, _: parameter_dtype(name, precision),
    modulated=False,
    state_token=True,
    marks=("state_proj", "action_time_mlp_"),
    state_in_prompt=False,
    prompt_tokens=48,
)
