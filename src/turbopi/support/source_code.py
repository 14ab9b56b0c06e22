"""A source file's code alone, for fingerprints that comments, docstrings and blank lines don't change."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path


def code_of(path: Path, errors: bool = True) -> str:
    """The text of a .py or .cu file without comments, docstrings, blank lines and spaces at the ends of lines.

    Cut out of the text, since the tokens and syntax trees of one file differ between Python versions. Without `errors`
    the texts of the errors that Python code raises are empty, however many lines they take.
    """
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".cu":
        text = _without_cuda_comments(text)
    else:
        text = _without_python_comments(text if errors else _without_error_texts(text))
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


def _without_error_texts(text: str) -> str:
    source = text.encode()  # syntax trees count columns in bytes
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    raised = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Raise)]
    for place in sorted({place for node in raised for place in _texts(node)}, reverse=True):
        row, column, end_row, end_column = place
        source = source[: starts[row - 1] + column] + b'""' + source[starts[end_row - 1] + end_column :]
    return source.decode()


def _texts(node: ast.AST) -> Iterator[tuple[int, int, int, int]]:
    """Where each text below a node stands: row, column, end row, end column. An f-string is one text."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.JoinedStr) or (isinstance(child, ast.Constant) and isinstance(child.value, str)):
            assert child.end_lineno is not None and child.end_col_offset is not None
            yield child.lineno, child.col_offset, child.end_lineno, child.end_col_offset
        else:
            yield from _texts(child)
