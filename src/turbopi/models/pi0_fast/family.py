"""Pi0-FAST as a family."""

from turbopi.config import Pi0FastConfig
from turbopi.models.family import Family
from turbopi.models.pi0.reference import parameter_dtype
from turbopi.models.pi0_fast.answers import reader
from turbopi.models.pi0_fast.reference import Pi0FastModel
from turbopi.models.pi0_fast.work import counts


def prompt(config: Pi0FastConfig, text: str, numbers: str) -> str:
    """The text that is tokenised. openpi: `FASTTokenizer.tokenize`; LeRobot: its state tokenizer step."""
    if config.owner == "openpi":
        text = text.lower().strip().replace("_", " ")
    else:
        text = text.strip().replace("_", " ").replace("\n", " ")
    return f"Task: {text}, State: {numbers};\n"


PI0_FAST = Family(
    "pi0_fast",
    "Pi0-FAST",
    Pi0FastModel,
    lambda name, precision, _: parameter_dtype(name, precision),
    modulated=False,
    state_token=False,
    marks=(),  # of the weights none is its own: it lacks an action expert
    state_step="pi0_fast_prepare_state_tokenizer_processor_step",
    prompt_tokens=200,
    planned=False,
    counts=counts,
    prompt=prompt,
    reader=reader,
)
