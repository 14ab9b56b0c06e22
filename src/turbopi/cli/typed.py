"""The library's messages in the words of the command line: it says `config=`, and the user typed `--config`."""

import re

# arguments of the Python interface whose messages reach the command line, and the options that they come from
OPTIONS = {
    "config": "--config",
    "robot": "--robot",
    "backend": "--backend",
    "precision": "--precision",
    "quantization": "--quantization",
    "num_denoising_steps": "--steps",
    "solver": "--solver",
    "time_grid": "--time-grid",
    "device": "--device",
    "tokenizer": "--tokenizer",
    "default_prompt": "--default-prompt",
    "strict": "--strict",
}
_ARGUMENT = re.compile(rf"""(?<![\w/.-])({"|".join(OPTIONS)})=(?:(['"])(.*?)\2)?""")  # config=, config='auto'


def as_typed(message: str) -> str:
    """`message` with each `name=`, or `name='value'`, as the option that stands for it on the command line."""

    def option(match: re.Match[str]) -> str:
        value = match[3]
        return OPTIONS[match[1]] if value is None else f"{OPTIONS[match[1]]} {value or repr(value)}"

    return _ARGUMENT.sub(option, message)
