"""The Python reference, written from the docstrings of every public name (docs/api.md says which are).

Signatures and docstrings are read from the source, so that they don't depend on the Python that writes them.
"""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import turbopi
from turbopi import config
from turbopi.checkpoint import Checkpoint
from turbopi.support import errors

_INTRODUCTION = """# Python reference

Written from the docstrings of this version. What of it stays the same between versions: [What is promised](api.md). A
server and clients: [Serving](serving.md); your own robot: [Robots](robots.md).

In shapes: H is the action horizon (actions in a chunk), `action_dim` the model's width of an action, d the robot's, B a
batch, h and w an image's height and width.
"""
_FIRST = ("UnifiedPolicy", "open_checkpoint", "PolicyConfig", "Robot", "RobotInputs")
_RELATED = (Checkpoint, config.ModelConfig, config.Normalization)
# module -> its public names, what a reader looks for first
_MODULES: dict[str, tuple[str, ...]] = {
    "turbopi.realtime": ("RealTimeExecutor", "RealTimeClient"),
    "turbopi.serve": ("run", "running", "PolicyServer", "ServerOptions"),
    "turbopi.robots": ("create_robot", "load_robot"),
    "turbopi.recordings": ("iter_recording", "load_observation"),
    "turbopi.realtime.wire": ("pack", "unpack"),
}
_ITEM = re.compile(r"(?P<name>[\w.*]+(?:, [\w.*]+)*)(?:: +| {2,})(?P<text>\S.*)")
_DOCUMENT = re.compile(r"\bdocs/(\w+\.md)")  # as docstrings name one
_Function = ast.FunctionDef | ast.AsyncFunctionDef


def reference() -> str:
    """The document's text."""
    public = [name for name in turbopi.__all__ if not name.startswith("_") and name != "errors"]
    raised = [name for name in public if issubclass(_class(name), Exception)]
    rest = [name for name in public if name not in (*_FIRST, *raised)]
    parts = [_INTRODUCTION, "## turbopi\n"]
    parts += [_described(getattr(turbopi, name), "###") for name in (*_FIRST, *rest)]
    parts.append("### Related classes\n")
    parts += [_described(one, "####") for one in _RELATED]
    parts.append("## turbopi.errors\n\n`from turbopi import …` has them, too.\n")
    parts += [f"- **`{name}`**: {_line(getattr(turbopi, name).__doc__)}{_bases(name)}" for name in raised]
    for name, first in _MODULES.items():
        parts += _module(importlib.import_module(name), first, {*_FIRST, *rest})
    return "\n".join(part.rstrip("\n") + "\n" if not part.startswith("- ") else part for part in parts) + "\n"


def _module(module: ModuleType, first: tuple[str, ...], described: set[str]) -> Iterator[str]:
    """Its own text, and a section for each public name that has none yet."""
    yield f"\n## {module.__name__}\n\n{_markdown(inspect.getdoc(module) or '')}\n"
    public: list[str] = getattr(module, "__all__", list(first))
    for name in sorted({*public} - described, key=lambda name: (name not in first, public.index(name))):
        found = getattr(module, name)
        is_code = inspect.isfunction(found) or inspect.isclass(found)
        yield _described(found, "###") if is_code else _value(module, name, found)


def _value(module: ModuleType, name: str, found: object) -> str:
    """The section of a name that is neither a class nor a function: its type, or what it stands for."""
    for file in sorted(Path(module.__file__ or "").parent.glob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == name:
                keys = f"\n\nIts keys: {', '.join(f'`{key}`' for key in found)}." if isinstance(found, Mapping) else ""
                return f"### {name}\n\n```python\n{name}: {ast.unparse(node.annotation)}\n```{keys}\n"
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
                return f"### {name}\n\n```python\n{ast.unparse(node)}\n```\n"
    raise ValueError(f"{module.__name__}.{name} has no assignment in its folder; expected one to read its type from")


def _class(name: str) -> type:
    found = getattr(turbopi, name)
    return found if isinstance(found, type) else object


def _bases(name: str) -> str:
    """The classes by which an error can be caught, too."""
    bases = [one.__name__ for one in _class(name).__bases__ if one not in (errors.TurboPiError, Exception)]
    return f" Also: {', '.join(bases)}." if bases else ""


def _line(docstring: str | None) -> str:
    return " ".join(inspect.cleandoc(docstring or "").split())


def _described(one: Any, heading: str) -> str:
    """The section of a class or function."""
    file = Path(inspect.getsourcefile(inspect.unwrap(one)) or "")  # behind a decorator
    source = file.read_text(encoding="utf-8")
    (node,) = (n for n in ast.parse(source).body if getattr(n, "name", None) == one.__name__)
    if isinstance(node, ast.ClassDef):
        return _class_section(node, source.splitlines(), heading)
    assert isinstance(node, _Function), one
    return f"{heading} {node.name}\n\n{_signature(node, node.name)}\n\n{_markdown(ast.get_docstring(node) or '')}\n"


def _class_section(node: ast.ClassDef, lines: list[str], heading: str) -> str:
    methods = [n for n in node.body if isinstance(n, _Function)]
    made = next((n for n in methods if n.name == "__init__"), None)
    parts = [f"{heading} {node.name}"]
    if made is not None:
        parts.append(_signature(made, node.name))
    parts.append(_markdown(ast.get_docstring(node) or ""))
    fields = [n for n in node.body if isinstance(n, ast.AnnAssign) and not ast.unparse(n.target).startswith("_")]
    rows = [_field(one, lines) for one in fields]
    if any(not row.endswith("|  |") for row in rows):
        parts.append("\n".join(["| field | type | unless given | |", "|---|---|---|---|", *rows]))
    elif rows:
        parts.append("Fields: " + ", ".join(f"`{ast.unparse(one)}`" for one in fields) + ".")
    for method in methods:
        text = ast.get_docstring(method)
        if method.name.startswith("_") or text is None:
            continue
        is_property = any("property" in ast.unparse(one) for one in method.decorator_list)
        signature = "" if is_property else f"{_signature(method, method.name)}\n\n"
        kind = ", a property" if is_property else ""
        parts.append(f"{heading}# {node.name}.{method.name}{kind}\n\n{signature}{_markdown(text)}")
    return "\n\n".join(part for part in parts if part) + "\n"


def _field(node: ast.AnnAssign, lines: list[str]) -> str:
    """A row; what it is stands in the comment behind the field."""
    assert node.end_lineno is not None and node.end_col_offset is not None
    line = lines[node.end_lineno - 1].encode()[node.end_col_offset :].decode()
    comment = line.partition("#")[2].strip()
    value = "" if node.value is None else f"`{ast.unparse(node.value)}`"
    cells = [f"`{ast.unparse(node.target)}`", f"`{ast.unparse(node.annotation)}`", value, comment]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _signature(node: _Function, name: str) -> str:
    """A code block: on one line, or an argument a line."""
    arguments = list(_arguments(node.args))
    returns = "" if node.returns is None or node.name == "__init__" else f" -> {ast.unparse(node.returns)}"
    returns = re.sub(r"^ -> '(.*)'$", r" -> \1", returns)
    whole = f"{name}({', '.join(arguments)}){returns}"
    if len(whole) > 100:
        whole = "\n".join([f"{name}(", *(f"    {one}," for one in arguments), f"){returns}"])
    return f"```python\n{whole}\n```"


def _arguments(given: ast.arguments) -> Iterator[str]:
    positional = [*given.posonlyargs, *given.args]
    defaults: list[ast.expr | None] = [None] * (len(positional) - len(given.defaults)) + [*given.defaults]
    for one, default in zip(positional, defaults, strict=True):
        if one.arg not in ("self", "cls"):
            yield _argument(one, default)
    if given.vararg is not None:
        yield f"*{given.vararg.arg}"
    elif given.kwonlyargs:
        yield "*"
    for one, default in zip(given.kwonlyargs, given.kw_defaults, strict=True):
        yield _argument(one, default)
    if given.kwarg is not None:
        yield f"**{given.kwarg.arg}"


def _argument(one: ast.arg, default: ast.expr | None) -> str:
    annotation = "" if one.annotation is None else f": {ast.unparse(one.annotation)}"
    value = "" if default is None else f" = {ast.unparse(default)}"
    return f"{one.arg}{annotation}{value}"


def _markdown(docstring: str) -> str:
    """A docstring as Markdown: lists of `name: text` or `name   text` as lists, other indented lines as code."""
    found = []
    for block in re.split(r"\n\s*\n", docstring):
        lines = block.split("\n")
        title = lines[0] if lines[0] == "Args:" else None
        body = inspect.cleandoc("\n".join(lines[1:] if title else lines)).split("\n")
        items = _items(body)
        if items is not None:
            found.append("\n".join(f"- `{name}`: {text}" for name, text in items))
        elif lines[0].startswith("    "):
            found.append("\n".join(["```", *body, "```"]))
        else:
            found.append("\n".join(line.strip() for line in lines))
    return _DOCUMENT.sub(r"[\g<0>](\g<1>)", "\n\n".join(found))


def _items(lines: list[str]) -> list[tuple[str, str]] | None:
    """(name, text) of a list whose further lines are indented; None if it isn't one.

    A line with more names than text has its text in the next.
    """
    items: list[tuple[str, str]] = []
    for line in lines:
        match = _ITEM.fullmatch(line)
        alone = re.fullmatch(r"[a-z]\w*(, [a-z]\w*)*", line)  # names, whose text follows
        if match is not None:
            items.append((match["name"], " ".join(match["text"].split())))
        elif alone is not None:
            items.append((line, ""))
        elif items and line.startswith(" "):
            items[-1] = (items[-1][0], f"{items[-1][1]} {' '.join(line.split())}".strip())
        else:
            return None
    return items if all(text for _, text in items) else None
