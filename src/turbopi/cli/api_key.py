"""The policy server's API key on a command line: from a file or the environment, where `ps` doesn't show it."""

import os
from pathlib import Path
from typing import Annotated

import typer

from turbopi.serve.options import key_in
from turbopi.support.errors import ConfigError

# hidden from --help: `ps` shows a key on the command line to everyone on the machine
ApiKey = Annotated[str | None, typer.Option("--api-key", envvar="TURBOPI_API_KEY", metavar="KEY", hidden=True)]
ApiKeyFile = Annotated[
    Path | None,
    typer.Option(
        "--api-key-file",
        metavar="FILE",
        help="The file's one line is the key that the server wants. The variable TURBOPI_API_KEY does the same.",
    ),
]


def chosen_key(given: str | None, file: Path | None) -> str | None:
    """The API key that the user means, None for none. Raises ConfigError if it can't be known."""
    if given is None and "TURBOPI_API_KEY" in os.environ:  # which the option takes for none, and would let all in
        raise ConfigError("TURBOPI_API_KEY is empty; give it the key, or unset it to do without one")
    if file is None:
        return given
    if given is not None:
        raise ConfigError("--api-key-file was given, and a key besides it (TURBOPI_API_KEY or --api-key); give one")
    return key_in(file)
