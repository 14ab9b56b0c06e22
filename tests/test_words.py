"""Names of files and identifiers are the field's: none is of the private words that the project once had."""

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PRIVATE = {  # the word, and what to write
    **dict.fromkeys(("picture", "pictures"), "image"),
    **dict.fromkeys(("film", "films"), "video"),
    **dict.fromkeys(("twin", "twins"), "reference"),
    **dict.fromkeys(("asked", "asking"), "requested"),
    "told": "given, reported",
    "whoever": "the client, the caller",
    "homes": "session affinity",
    "urgency": "scheduling options, deadline",
    "offers": "capabilities",
    "wording": "text",
    "gone": "closed, lost",
}
SUSPECT = re.compile("|".join(PRIVATE), re.IGNORECASE)
PARTS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")


def tracked(pattern: str) -> list[Path]:
    listed = subprocess.run(["git", "ls-files", pattern], cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.splitlines()]


def private_words(name: str) -> set[str]:
    return {part.lower() for part in PARTS.findall(name)} & PRIVATE.keys()


def identifiers(text: str) -> Iterator[str]:
    """Names that code gives to things. Tests are named as claims, in plain English."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if not node.name.startswith("test_"):
                yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr


def test_a_private_word_would_be_found() -> None:
    assert set(identifiers("class TwinKernel:\n    def f(self, asked):\n        self._told = film = 1")) == {
        *("TwinKernel", "f", "self", "asked", "_told", "film")
    }
    assert private_words("TwinKernel") == {"twin"} and private_words("_per_picture") == {"picture"}
    assert not private_words("unmasked") and not private_words("ASKED_FOR".replace("ASKED", "MASKED"))


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no clone")
def test_no_identifier_has_a_private_word() -> None:
    files = [path for path in tracked("*.py") if path.name != "test_words.py"]
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in files}
    suspects = [name for name, text in texts.items() if SUSPECT.search(text)]  # only these are parsed
    found = {(name, one) for name in suspects for one in identifiers(texts[name]) if private_words(one)}
    assert len(files) > 500 and not found, {word: PRIVATE[word] for _, one in found for word in private_words(one)}


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no clone")
def test_no_file_name_has_a_private_word() -> None:
    names = [path.relative_to(ROOT) for path in tracked(".") if not path.is_relative_to(ROOT / "benchmarks/results")]
    assert not {str(name) for name in names for part in name.parts if private_words(part)}


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no clone")
def test_no_message_calls_a_matmul_a_product() -> None:
    """Kernels name what they are made of; what users read is the field's word."""
    found = set()
    for path in tracked("src/turbopi/*.py"):
        text = path.read_text(encoding="utf-8")
        if "product" not in text or path.relative_to(ROOT / "src/turbopi").parts[0] in ("kernels", "engine", "tune"):
            continue
        tree = ast.parse(text)
        lines = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
        strings = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in lines]
        found |= {
            one.value
            for one in strings
            if isinstance(one.value, str) and re.search(r"\bproducts? | products?\b", one.value)
        }
    assert not found
