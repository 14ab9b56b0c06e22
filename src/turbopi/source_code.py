"""A source file's code alone, for fingerprints that comments, docstrings and blank lines don't change."""

import ast
import io
import re
import tokenize
from pathlib import Path


def code_of(path: Path) -> str:
    """The text of a .py or .cu file without comments, docstrings, blank lines and spaces at the ends of lines.

    Cut out of the text, since the tokens and syntax trees of one file differ between Python versions.
    """
    text = path.read_text(encoding="utf-8")
    text = _without_cuda_comments(text) if path.suffix == ".cu" else _without_python_comments(text)
    return "\n".join(line.rstrip() for line in text.splitlines() if line.strip())


def _without_cuda_comments(text: str) -> str:
    strings_or_comments = r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/'
    return re.sub(strings_or_comments, lambda m: m[0] if m[0][0] == '"' else " ", text, flags=re.DOTALL)


def _without_python_comments(text: str) -> str:
    lines = text.splitlines(keepends=True)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column] + "\n"
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) or not node.body:
            continue
        first = node.body[0]
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            assert first.end_lineno is not None
            for row in range(first.lineno, first.end_lineno + 1):
                lines[row - 1] = "\n"
    return "".join(lines)
