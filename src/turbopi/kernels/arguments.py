"""A kernel's parameters, declared once: C++ text for its source, ctypes values for its launch.

Values reach a kernel by their order and size alone, and nothing on a GPU notices two pointers that changed places. So
the order is written down in one place, launches give values by name, and the compiler checks a struct's sizes.
"""

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

_NUMBERS: dict[str, Any] = {
    "int": ctypes.c_int,
    "u32": ctypes.c_uint32,
    "float": ctypes.c_float,
    "long long": ctypes.c_longlong,
}
TENSOR_MAP = "const __grid_constant__ TensorMap"


@dataclass(frozen=True)
class Parameter:
    """`type` is C++: a pointer, a number (int, u32, float, long long), or TENSOR_MAP."""

    type: str
    name: str
    about: str = ""

    @property
    def declaration(self) -> str:
        return f"{self.type}{'' if self.type.endswith('*') else ' '}{self.name}"

    def value(self, given: Any) -> Any:
        """`given` as ctypes has it: a number, an address (None: a null pointer), a tensor map."""
        if self.type == TENSOR_MAP:
            return given
        if self.type.endswith("*"):
            assert given is None or isinstance(given, int), f"{self.name} takes an address, not {given!r}"
            return ctypes.c_void_p(given)
        assert isinstance(given, int | float), f"{self.name} takes a number, not {given!r}"
        return _NUMBERS[self.type](given)


@dataclass(frozen=True)
class Parameters:
    """What a kernel takes, in its order."""

    all: tuple[Parameter, ...]

    @property
    def declarations(self) -> str:
        """For the kernel's parentheses."""
        return ", ".join(one.declaration for one in self.all)

    def values(self, given: Mapping[str, Any]) -> tuple[Any, ...]:
        """ctypes values in the kernel's order. `given` must name each parameter, and nothing else."""
        _check_names(self.all, given)
        return tuple(one.value(given[one.name]) for one in self.all)


@dataclass(frozen=True)
class Struct:
    """A struct that is a kernel's one parameter: its C++ text, and its values."""

    name: str
    fields: tuple[Parameter, ...]

    @cached_property
    def ctype(self) -> type[ctypes.Structure]:
        kinds = [(one.name, ctypes.c_void_p if one.type.endswith("*") else _NUMBERS[one.type]) for one in self.fields]
        return type(self.name, (ctypes.Structure,), {"_fields_": kinds})

    @property
    def source(self) -> str:
        """The struct, and asserts that it and its fields have the sizes that `ctype` gives them.

        The order is the same by construction, and with equal sizes so are the offsets (NVRTC has no offsetof).
        """
        lines = [f"  {one.declaration};" + (f"  // {one.about}" if one.about else "") for one in self.fields]
        of_fields = {f"{self.name}::{one.name}": getattr(self.ctype, one.name).size for one in self.fields}
        sizes = {self.name: ctypes.sizeof(self.ctype)} | of_fields
        checks = [f'static_assert(sizeof({what}) == {size}, "arguments.py disagrees");' for what, size in sizes.items()]
        return "\n".join((f"struct {self.name} {{", *lines, "};", *checks))

    def value(self, given: Mapping[str, Any]) -> ctypes.Structure:
        """`given` must name each field, and nothing else."""
        _check_names(self.fields, given)
        return self.ctype(**given)


def enumeration(name: str, values: Sequence[str]) -> str:
    """A C++ enum of `values`, from 0 on."""
    return f"enum {name} {{ {', '.join(values)} }};"


def _check_names(declared: tuple[Parameter, ...], given: Mapping[str, Any]) -> None:
    names = {one.name for one in declared}
    assert len(names) == len(declared), "a name stands twice"
    assert names == given.keys(), f"missing: {sorted(names - given.keys())}, unknown: {sorted(given.keys() - names)}"
