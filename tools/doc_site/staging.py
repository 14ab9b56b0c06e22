"""The site's sources: the documents, what they link to, and the pages that are written anew, in one folder.

The folder has the clone's own layout, so that a link that works on GitHub works in the site.
"""

import re
import shutil
from collections.abc import Mapping
from pathlib import Path

# what nobody needs to link to: mkdocs.yml has them in its navigation, or building the site fails
_ROOTS = ("*.md", "docs/*.md", "docs/dev/**/*.md")
_LINK = re.compile(r"(?P<before>\]\()(?P<path>[^()\s#]+)(?P<anchor>#[^()\s]*)?(?=\))")


def stage(root: Path, folder: Path, written: Mapping[str, str]) -> None:
    """Fill `folder` anew. `written` has the text of pages, by their path in the clone; such a page replaces a document.

    Every file that a page links to lies in the folder, too: result files, examples, source files. A folder that is
    linked to gets a page that lists its files, unless it has a README.md. Raises FileNotFoundError for a dead link.
    """
    shutil.rmtree(folder, ignore_errors=True)
    pages = [path.relative_to(root).as_posix() for pattern in _ROOTS for path in sorted(root.glob(pattern))]
    waiting = [*written, *pages]
    staged: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in staged:
            continue
        staged.add(name)
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if not name.endswith(".md"):
            shutil.copyfile(root / name, file)
            continue
        text = written.get(name) or _page(root, name)
        text, linked = _resolved(text, root, name, written)
        file.write_text(text, encoding="utf-8")
        waiting += linked


def _page(root: Path, name: str) -> str:
    """A document's text, or the list of a folder's files."""
    if (root / name).is_file():
        return (root / name).read_text(encoding="utf-8")
    folder = (root / name).parent
    files = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    return f"# {folder.name}\n\n" + "".join(f"- [{file}]({file})\n" for file in files)


def _resolved(text: str, root: Path, name: str, written: Mapping[str, str]) -> tuple[str, list[str]]:
    """The text with links to folders' pages instead of folders, and the paths in the clone that it links to."""
    linked = []

    def resolve(found: re.Match[str]) -> str:
        path = found["path"]
        if re.match(r"[a-z]+:", path):
            return found[0]  # the web's
        target = (root / name).parent.joinpath(path).resolve().relative_to(root.resolve())
        if (root / target).is_dir():
            page = "README.md" if (root / target / "README.md").is_file() else "index.md"
            path, target = f"{path.rstrip('/')}/{page}", target / page
        elif target.as_posix() not in written and not (root / target).is_file():
            raise FileNotFoundError(f"{name} links to {path}, which isn't there")
        linked.append(target.as_posix())
        return f"{found['before']}{path}{found['anchor'] or ''}"

    return _LINK.sub(resolve, text), linked
