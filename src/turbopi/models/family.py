"""What a family of models gives beside its sizes (config.py) and its reference: what all other code asks about it."""

from dataclasses import dataclass

from turbopi.config import Kind


@dataclass(frozen=True)
class Family:
    """kind: its name in files and metadata; label: in sentences.

    The loop that the engine, the backends and the roofline plan by:

    modulated        the time scales, shifts and gates the expert's norms (adaRMS); else it is mixed into the actions'
                     tokens
    state_token      the state is a token before the actions, which it doesn't see; else it is in the prompt or nowhere

    Its checkpoints and prompts:

    marks            beginnings of names of weights that only this family has, the most telling one first
    state_in_prompt  whether LeRobot writes the state into the prompt; else the prompt is taken as it is
    prompt_tokens    LeRobot's longest prompt, unless a checkpoint says another
    """

    kind: Kind
    label: str
    modulated: bool
    state_token: bool
    marks: tuple[str, ...]
    state_in_prompt: bool
    prompt_tokens: int
