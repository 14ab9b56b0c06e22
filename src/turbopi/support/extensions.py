"""What other distributions add to Turbo-Pi: entry points of the groups turbopi.backends and turbopi.commands.

Finding them reads the metadata of what is installed and imports nothing; `Extension.load` imports one. One that can't
be used is named in a warning and skipped, so that it harms only those who use it. How to write one: docs/extending.md.
"""

import logging
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from typing import Any

from turbopi.support.errors import ConfigError

logger = logging.getLogger(__name__)

BACKENDS, COMMANDS = "turbopi.backends", "turbopi.commands"


@dataclass(frozen=True)
class Extension:
    """An entry point.

    name          what a user types
    value         "module:object"
    distribution  its name and version
    summary       the distribution's one line about itself; may be empty
    """

    group: str
    name: str
    value: str
    distribution: str
    summary: str

    def __str__(self) -> str:
        return f"entry point {self.name!r} = {self.value!r} in {self.group}, of {self.distribution}"

    def load(self) -> Any:
        """The object. Raises ConfigError with the reason if it can't be imported."""
        try:
            return metadata.EntryPoint(self.name, self.value, self.group).load()
        except (Exception, SystemExit) as error:  # foreign code may raise anything
            raise ConfigError(f"can't load the {self}: {reason(error)}") from error


def reason(error: BaseException) -> str:
    """The error on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def found(group: str, built_in: Collection[str]) -> Mapping[str, Extension]:
    """The usable extensions of a group by name. Each of the others is named in a warning, once."""
    return _found(group, frozenset(built_in), tuple(sys.path))


@lru_cache(maxsize=16)
def _found(group: str, built_in: frozenset[str], path: tuple[str, ...]) -> Mapping[str, Extension]:
    by_name: dict[str, list[Extension]] = {}
    for one in _read(group):
        if not re.fullmatch(r"[\w.]+:[\w.]+", one.value):
            logger.warning("skipped the %s: expected module:object", one)
        elif one.name in built_in:
            logger.warning("skipped the %s: Turbo-Pi has a %r of its own", one, one.name)
        else:
            by_name.setdefault(one.name, []).append(one)
    for several in by_name.values():
        if len(several) > 1:
            logger.warning("skipped, as they have one name, the %s", "; the ".join(sorted(map(str, several))))
    return {name: several[0] for name, several in sorted(by_name.items()) if len(several) == 1}


def _read(group: str) -> Iterator[Extension]:
    try:
        points = list(metadata.entry_points(group=group))
    except Exception:  # somebody's metadata is damaged: find out whose
        points = list(_by_distribution(group))
    for point in points:
        about: Any = point.dist.metadata if point.dist is not None else {}
        named = f"{about['Name']} {about['Version']}" if about else "a distribution without a name"
        yield Extension(group, point.name, point.value, named, about["Summary"] or "" if about else "")


def _by_distribution(group: str) -> Iterator[metadata.EntryPoint]:
    seen = set()
    for distribution in metadata.distributions():
        name = "a distribution"
        try:
            name = distribution.metadata["Name"]
            if name not in seen:  # the first on sys.path is the one that is imported
                yield from distribution.entry_points.select(group=group)
            seen.add(name)
        except Exception as error:
            logger.warning("skipped the entry points of %s, which can't be read: %s", name, reason(error))
