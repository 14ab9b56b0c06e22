"""A tokenizer.json of any kind, by the `tokenizers` library, as transformers runs it: SmolVLA's."""

from pathlib import Path
from typing import Any

from turbopi.preprocess.tokenizer_json import TOKENIZER_CONFIG
from turbopi.support.errors import TokenizerError
from turbopi.support.installation import install_command
from turbopi.support.reading import one_line, read_bytes, read_json, shown

_MAX_BYTES = 64 * 2**20


class HubTokenizer:
    """`file`'s tokenizer, as an encoder. size: of its vocabulary, with added tokens.

    truncation_side  which end of a prompt that is too long is lost, by the tokenizer_config.json beside it

    Raises TokenizerError for a file that can't be read, and without the library.
    """

    def __init__(self, file: Path) -> None:
        try:
            import tokenizers
        except ImportError as error:
            raise TokenizerError(
                f"{file} needs the library tokenizers, which isn't installed: {install_command('smolvla')}"
            ) from error
        content = read_bytes(file, TokenizerError, limit=_MAX_BYTES)
        try:
            self._tokenizer: Any = tokenizers.Tokenizer.from_str(content.decode())
        except Exception as error:  # the library raises plain ones
            raise TokenizerError(f"{file} can't be read as a tokenizer: {one_line(error)}") from error
        self._tokenizer.no_truncation()
        self._tokenizer.no_padding()
        self.size: int = self._tokenizer.get_vocab_size(with_added_tokens=True)
        beside = file.parent / TOKENIZER_CONFIG
        side = read_json(beside, TokenizerError).get("truncation_side", "right") if beside.is_file() else "right"
        if side not in ("left", "right"):
            raise TokenizerError(f"{beside}: truncation_side is {shown(side)}; expected left or right")
        self.truncation_side: str = side

    def encode(self, text: str, *, add_bos: bool) -> list[int]:
        """The text's ids; whatever the file itself puts around a text (`post_processor`) is added, and no other BOS."""
        ids: list[int] = self._tokenizer.encode(text).ids
        return ids
