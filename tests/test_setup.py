"""scripts/setup: which PyTorch a machine gets, and what it is told. Python, pip and the GPU are made up."""

import ast
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import gpu_evidence
import pytest

ROOT = Path(__file__).parents[1]
HAS_DRIVER = Path("/proc/driver/nvidia/version").exists()
no_driver = pytest.mark.skipif(HAS_DRIVER, reason="this machine has an NVIDIA driver, which scripts/setup finds")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="on macOS every PyTorch is a CPU build")

# Makes environments of copies of itself, has no package, and writes down what pip is asked for.
PYTHON = f"""#!/bin/sh
case "$*" in
  "-m venv "*) mkdir -p "$3/bin"; cp "$0" "$3/bin/python" ;;
  "-m pip "*) shift 2; echo "$*" >>"$PIP_LOG"; [ -z "$PIP_FAILS" ] ;;
  "-c import torch" | "-c import triton" | "-c import cuda.bindings.nvrtc") exit 1 ;;
  *) exec "{sys.executable}" "$@" ;;
esac
"""

ANY = "torch --no-deps"  # a PyTorch for tests about something else: with an option, so that no index is asked


class Machine:
    """A new user's machine: a clone, an interpreter, and perhaps a GPU and a way to PyTorch's index."""

    def __init__(self, folder: Path) -> None:
        self.clone, self.bin, self.log = folder / "clone", folder / "bin", folder / "pip.log"
        (self.clone / "scripts").mkdir(parents=True)
        self.bin.mkdir()
        shutil.copy(ROOT / "scripts" / "setup", self.clone / "scripts" / "setup")
        shutil.copy(ROOT / "pyproject.toml", self.clone / "pyproject.toml")
        self.program("python3", PYTHON)
        self.program("nvidia-smi", "#!/bin/sh\nexit 127\n")
        self.program("ldconfig", "#!/bin/sh\necho '\tlibc.so.6 (libc6,x86-64) => /lib/libc.so.6'\n")

    def program(self, name: str, text: str) -> None:
        (self.bin / name).write_text(text)
        (self.bin / name).chmod(0o755)

    def setup(self, *words: str, ok: bool = True, to: int = subprocess.PIPE, **environment: str) -> str:
        """What scripts/setup says. `to`: where its output goes instead."""
        kept = {key: value for key, value in os.environ.items() if key not in ("TORCH", "PYTHON", "VENV")}
        path = f"{self.bin}:/usr/bin:/bin"
        kept |= {"PATH": path, "PIP_LOG": str(self.log), "PIP_FAILS": "", "no_proxy": "127.0.0.1"}
        command = ["bash", str(self.clone / "scripts" / "setup"), *words]
        ended = subprocess.run(
            command, env=kept | environment, stdout=to, stderr=subprocess.PIPE, text=True, check=False
        )
        said = (ended.stdout or "") + ended.stderr
        assert (ended.returncode == 0) is ok, said
        return said

    def installed(self) -> list[str]:
        """What pip was asked to install, a line a call."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return [line.removeprefix("install --disable-pip-version-check --quiet ") for line in lines]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


@pytest.fixture
def index(tmp_path: Path) -> Iterator[str]:
    """An index of CPU builds that answers."""
    (tmp_path / "index" / "torch").mkdir(parents=True)
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "index"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.fixture
def nowhere() -> Iterator[str]:
    """An address at which nothing listens, and which nobody else gets meanwhile."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"http://127.0.0.1:{taken.getsockname()[1]}"


def pins() -> dict[str, str]:
    """{package: version} of the extra cuda."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extra = re.search(r"^cuda = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    assert extra is not None
    return dict(re.findall(r'^ *"([\w-]+)==([^"]+)"', extra[1], re.MULTILINE))


@no_driver
def test_without_a_gpu_the_cpu_build_is_taken(machine: Machine, index: str) -> None:
    said = machine.setup(TORCH_CPU_INDEX=index)
    assert machine.installed() == [f"--index-url {index} torch==2.13.0", "--editable ."]
    assert "no NVIDIA GPU" in said and "200 MB" in said and "70 MB" in said


@no_driver
@pytest.mark.parametrize("answer", ["none", "not found"])
def test_an_index_out_of_reach_is_done_without_and_said(
    machine: Machine, index: str, nowhere: str, answer: str
) -> None:
    said = machine.setup(TORCH_CPU_INDEX=nowhere if answer == "none" else f"{index}/elsewhere")
    assert machine.installed() == ["torch==2.13.0", "--editable ."]
    assert "doesn't answer" in said and "3 GB" in said


@no_driver
def test_an_index_that_fails_later_says_what_else_there_is(machine: Machine, index: str) -> None:
    said = machine.setup(ok=False, TORCH_CPU_INDEX=index, PIP_FAILS="yes")
    assert f"torch==2.13.0 can't be had from {index}" in said and "TORCH='torch==2.13.0 --index-url" in said
    assert not (machine.clone / ".venv" / ".turbopi-run").exists()


@no_driver
def test_a_driver_program_without_a_gpu_is_no_gpu(machine: Machine, index: str) -> None:
    machine.program("nvidia-smi", "#!/bin/sh\necho 'No devices were found'\nexit 6\n")
    machine.setup(TORCH_CPU_INDEX=index)
    assert machine.installed()[0] == f"--index-url {index} torch==2.13.0"


@pytest.mark.parametrize("how", ["nvidia-smi", "libcuda"])
def test_with_a_gpu_the_tested_versions_are_taken(machine: Machine, nowhere: str, how: str) -> None:
    if how == "nvidia-smi":
        machine.program("nvidia-smi", "#!/bin/sh\necho 'GPU 0: NVIDIA H200 (UUID: GPU-0)'\n")
    else:
        machine.program("ldconfig", "#!/bin/sh\necho '\tlibcuda.so.1 (libc6,x86-64) => /usr/lib/libcuda.so.1'\n")
    said = machine.setup(TORCH_CPU_INDEX=nowhere)
    assert machine.installed() == ["--editable .[cuda]", "--editable ."]
    assert "3 GB" in said and (how in said or HAS_DRIVER)


@no_driver
def test_another_pytorch_is_the_cpu_build_too(machine: Machine, index: str) -> None:
    machine.setup(TORCH="torch==2.8.0", TORCH_CPU_INDEX=index)
    assert machine.installed()[0] == f"--index-url {index} torch==2.8.0"


@pytest.mark.parametrize("torch", ["torch==2.8.0", "torch==2.8.0 --index-url https://example.org/cu128"])
def test_on_a_gpu_a_pytorch_that_is_asked_for_is_taken(machine: Machine, nowhere: str, torch: str) -> None:
    machine.program("nvidia-smi", "#!/bin/sh\necho 'GPU 0: NVIDIA H200 (UUID: GPU-0)'\n")
    said = machine.setup(TORCH=torch, TORCH_CPU_INDEX=nowhere)
    assert machine.installed()[0] == torch and torch in said


def test_a_second_run_installs_nothing(machine: Machine) -> None:
    machine.setup(TORCH=ANY)
    before = machine.installed()
    assert machine.setup(TORCH=ANY) == "" and machine.installed() == before


def test_a_terminal_sees_pips_progress(machine: Machine) -> None:
    master, slave = os.openpty()
    try:
        machine.setup(TORCH=ANY, to=slave)
    finally:
        os.close(slave)
        os.close(master)
    assert machine.log.read_text().splitlines()[0] == f"install --disable-pip-version-check {ANY}"


def test_another_folder_and_interpreter(machine: Machine) -> None:
    (machine.bin / "python3").rename(machine.bin / "python3.99")
    machine.setup(TORCH=ANY, PYTHON="python3.99", VENV=".venv-3.99")
    assert (machine.clone / ".venv-3.99" / "bin" / "python").exists()
    assert not (machine.clone / ".venv").exists()


def test_the_tests_take_the_extras_versions_of_what_cpu_builds_lack(machine: Machine) -> None:
    machine.setup("dev", TORCH=ANY)
    pinned = pins()
    triton, nvrtc = machine.installed()[-2:]
    assert triton.split()[0] == f"triton=={pinned['triton']}"
    wanted = [f"{name}=={pinned[name]}" for name in ("cuda-bindings", "nvidia-cuda-nvrtc")]
    assert nvrtc.split() == wanted


def test_the_extra_cuda_is_what_the_gpu_tests_ran_with() -> None:
    ran = json.loads(gpu_evidence.result_files()[-1].read_text(encoding="utf-8"))["provenance"]
    pinned = pins()
    assert pinned["torch"] == ran["torch"].split("+")[0] and pinned["triton"] == ran["triton"]


# --- what the fast tests need -----------------------------------------------------------------------------------------

LEFT_OUT = {"lerobot", "libero", "modelopt", "mujoco", "openpi_client", "ray", "rerun", "robosuite", "tensorrt_rtx"}
LEFT_OUT |= {"vla_eval"}
FILES = [*(ROOT / "tests").glob("test_*.py"), *(ROOT / "packages/turbopi-lab/tests").glob("test_*.py")]


def needed(*code: ast.AST) -> set[str]:
    """Packages of other extras that code imports, or that it skips without."""
    found: set[str] = set()
    for node in (node for one in code for node in ast.walk(one)):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").partition(".")[0])
        elif isinstance(node, ast.Call) and re.search(r"\b(importorskip|find_spec)$", ast.unparse(node.func)):
            found |= {str(argument.value) for argument in node.args if isinstance(argument, ast.Constant)}
    return found & LEFT_OUT


def fast_tests_that_need_more(text: str) -> dict[str, set[str]]:
    """{"" for the file itself, or a test: packages}."""
    body = ast.parse(text).body
    given = {ast.unparse(one.targets[0]): one.value for one in body if isinstance(one, ast.Assign)}
    if "mark.slow" in ast.unparse(given.get("pytestmark", ast.Constant(None))):
        return {}
    functions = [node for node in ast.walk(ast.Module(body, [])) if isinstance(node, ast.FunctionDef)]
    tests = [one for one in functions if "pytest.mark.slow" not in map(ast.unparse, one.decorator_list)]
    found = {
        one.name: needed(one, *(given[name] for name in map(ast.unparse, one.decorator_list) if name in given))
        for one in tests
        if one.name.startswith("test_")
    }
    found[""] = needed(*(one for one in body if isinstance(one, ast.Import | ast.ImportFrom | ast.Expr)))
    return {name: packages for name, packages in found.items() if packages}


def test_no_fast_test_needs_a_package_that_setup_dev_leaves_out() -> None:
    found = {file.name: fast_tests_that_need_more(file.read_text(encoding="utf-8")) for file in FILES}
    assert not {file: tests for file, tests in found.items() if tests}


def test_what_a_test_needs_is_seen_in_its_code_its_marks_and_its_file() -> None:
    text = """
import {package}
with_it = pytest.mark.skipif(find_spec("rerun") is None)
@with_it
def test_marked(): pass
def test_importing(): from libero.libero import envs
{mark}
def test_slow(): pytest.importorskip("ray")
"""
    found = fast_tests_that_need_more(text.format(package="ray.serve", mark="@pytest.mark.slow"))
    assert found == {"": {"ray"}, "test_marked": {"rerun"}, "test_importing": {"libero"}}
    assert "test_slow" in fast_tests_that_need_more(text.format(package="os", mark="# fast"))
