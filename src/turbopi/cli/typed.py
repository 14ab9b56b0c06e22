"""The library's messages in the words of the command line: it says `config=`, and the user typed `--config`."""

import re
from collections.abc import Collection

# arguments of the Python interface whose messages reach the command line, and the options that they come from
OF_POLICIES = {
    "config": "--config",
    "robot": "--robot",
    "backend": "--backend",
    "precision": "--precision",
    "quantization": "--quantization",
    "num_denoising_steps": "--steps",
    "solver": "--solver",
    "time_grid": "--time-grid",
    "guidance": "--guidance",
    "guidance_tag": "--guidance-tag",
    "device": "--device",
    "tokenizer": "--tokenizer",
    "default_prompt": "--default-prompt",
    "strict": "--strict",
    "out_of_range": "--out-of-range",
    "known_cameras": "--known-cameras",
}
OF_SERVERS = {
    "host": "--host",
    "port": "--port",
    "api_key": "--api-key",
    "max_message_mb": "--max-message-mb",
    "queue_limit": "--queue-limit",
    "max_batch": "--max-batch",
    "deadline_ms": "--deadline-ms",
    "record_dir": "--record",
    "record_limit": "--record-limit",
    "record_images": "--record-images",
    "allowed_hosts": "--allowed-hosts",
    "max_clients": "--max-clients",
    "traces": "--traces",
    "page": "--page",
    "execution": "--execution",
    "control_hz": "--control-hz",
    "execution_horizon": "--execution-horizon",
    "delay_steps": "--delay-steps",
    "autoscaling": "--autoscaling",
}
OF_EVALUATIONS = {
    "seed": "--seed",
    "seeding": "--seeding",
    "replan": "--replan",
    "wait_steps": "--wait-steps",
    "max_steps": "--max-steps",
    "camera_px": "--camera-px",
    "image_px": "--image-px",
}
OPTIONS = {**OF_POLICIES, **OF_SERVERS, **OF_EVALUATIONS}
_ARGUMENT = re.compile(  # config=, config='auto', queue_limit=-1
    rf"""(?<![\w/.-])({"|".join(OPTIONS)})=(?:(['"])(.*?)\2|([^\s,;:()'"]+(?<!\.)))?"""
)
_ADVICE = re.compile(r"\b(?:use|take) [^;:]*")  # use backend 'pytorch' or 'onnx'
_OPTION = re.compile(r"--[a-z][a-z-]*")
_ADVISED = re.compile(r"\b(backend|precision|solver|time grid) ('\w+'(?:(?:, | or )'\w+')*)")


def as_typed(message: str, options: Collection[str] = ()) -> str:
    """`message` with arguments as the options that stand for them on the command line.

    options   the command's own: where it has --backends alone, --backend is called so

    An argument is `name=`, `name='value'` or `name=1.5`; or in advice, after "use" or "take", `backend 'value'`.
    """

    def option(match: re.Match[str]) -> str:
        value = match[3] if match[4] is None else match[4]
        return OPTIONS[match[1]] if value is None else f"{OPTIONS[match[1]]} {value or repr(value)}"

    def advised(match: re.Match[str]) -> str:
        return f"{OPTIONS[match[1].replace(' ', '_')]} {match[2].replace(chr(39), '')}"

    message = _ARGUMENT.sub(option, message)
    message = _ADVICE.sub(lambda advice: _ADVISED.sub(advised, advice[0]), message)
    return _OPTION.sub(lambda it: f"{it[0]}s" if it[0] not in options and f"{it[0]}s" in options else it[0], message)
