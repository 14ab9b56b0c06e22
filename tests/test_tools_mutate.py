"""The table of planted faults stays true: each text stands once in the code, each test is of the fast tier."""

import ast
import re
from functools import lru_cache

import pytest
from mutate.__main__ import ROOT, TABLE, Ran, table
from mutate.faults import FAULTS, Fault, place

SOURCE = ROOT / "src"


@lru_cache
def fast_tests(file: str) -> set[str]:
    """Tests of a file that `scripts/test` runs."""
    nodes = ast.parse((ROOT / file).read_text(encoding="utf-8")).body
    marks = [ast.unparse(node) for node in nodes if isinstance(node, ast.Assign)]
    if any(one.startswith("pytestmark") and "mark.slow" in one for one in marks):
        return set()
    tests = [node for node in nodes if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return {node.name for node in tests if "pytest.mark.slow" not in map(ast.unparse, node.decorator_list)}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_faults_text_stands_once_in_the_code_and_its_tests_are_fast(fault: Fault) -> None:
    assert place(fault, SOURCE).is_file() and fault.planted != fault.text
    for test in fault.tests:
        file, _, name = test.partition("::")
        assert name in fast_tests(file) if name else fast_tests(file)


def test_a_fault_whose_text_is_gone_or_stands_twice_is_named() -> None:
    one = Fault("gone", "turbopi.kernels", "no such text at all", "", "", ())
    with pytest.raises(ValueError, match=r"'gone': .* it is in nowhere"):
        place(one, SOURCE)
    with pytest.raises(ValueError, match=r"'often': .*__init__\.py \("):
        place(Fault("often", "turbopi", '"""', "", "", ()), SOURCE)


def test_the_checked_in_table_is_of_these_faults_and_the_tool_that_writes_it() -> None:
    rows = re.findall(r"^\| (.*?) \| .* \| (.*?) \|$", TABLE.read_text(), re.MULTILINE)[1:]
    assert [name for name, _ in rows] == [fault.name for fault in FAULTS]
    assert table([], "abc").splitlines()[0] == TABLE.read_text().splitlines()[0]


def test_a_row_says_which_tests_failed_or_that_none_did() -> None:
    fault = FAULTS[0]
    names = [f"test_a::test_{name}[{i}]" for name in ("x", "y", "z") for i in range(3)]
    found, unseen = table([(fault, Ran(9, 0, names)), (fault, Ran(9, 0, []))], "abc").splitlines()[-2:]
    assert found.endswith("| `test_a::test_x`, `test_a::test_y` and 1 more |")
    assert unseen.endswith("| **not found** |")
