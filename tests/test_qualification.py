"""A GPU that no test ever ran on is qualified once: whatever the process says or does, there is a verdict.

The processes here are stand-ins that say what a GPU's would, or hang, or die.
"""

import json
import re
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from shared import TWO_LAYERS

from turbopi import backends
from turbopi.backends import qualification, qualifying
from turbopi.backends.base import Precision
from turbopi.backends.fused import FusedBackend
from turbopi.backends.qualification import DENOISE, file_of, kept
from turbopi.backends.qualifying import STAGES, qualify
from turbopi.config import ModelConfig
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.support.files import alone_in

GPU, MODEL = torch.device("cuda", 0), ModelConfig()
RIGHT = """
say(stage={"name": "grid barrier", "seconds": 1.0, "text": "holds", "figures": {"barrier us": 1.2}})
say(milliseconds={"fused": {"total": 20.0}, "cuda_graph": {"total": 30.0}}, memory=7, taken="fused", reason="right")
say(done=True)
"""
Child = Callable[[str], None]


@pytest.fixture
def started(tmp_path: Path) -> Path:
    """A file with a line for each process that was started: what it was to exclude."""
    return tmp_path / "started"


@pytest.fixture
def child(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, started: Path) -> Child:
    """Pretends that there is a GPU, and that its process runs some code."""
    properties = SimpleNamespace(name="NVIDIA Fake", major=8, minor=9, multi_processor_count=9, total_memory=24 << 30)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: properties.name)
    monkeypatch.setattr(qualification, "_driver", lambda: "580.1")
    monkeypatch.setattr(qualification, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(qualification, "_UNKEPT", {})
    monkeypatch.setattr(FusedBackend, "unavailable", classmethod(lambda cls, device: None))
    monkeypatch.setattr(FusedBackend, "unavailable_in", classmethod(lambda cls, device, precision: None))

    def runs(code: str) -> None:
        head = f"""
        import json, os, sys, time
        request = json.load(sys.stdin)
        excluded = request["excluded"]
        with open({str(started)!r}, "a") as log:
            print(",".join(excluded), file=log)
        say = lambda **event: print(json.dumps(event), flush=True)
        hang = lambda: time.sleep(600)
        """
        monkeypatch.setattr(qualifying, "_command", lambda: [sys.executable, "-S", "-c", textwrap.dedent(head) + code])

    return runs


def starts(file: Path) -> list[str]:
    return file.read_text().splitlines() if file.exists() else []


def chosen(precision: Precision = "bf16") -> str:
    """As a policy chooses."""
    backends.qualified(GPU, precision, MODEL)
    return backends.choose(GPU, precision, MODEL)[0]


def test_the_faster_one_that_is_right_is_taken_and_it_is_found_out_once(child: Child, started: Path) -> None:
    child(RIGHT)
    assert chosen() == chosen() == "fused" and len(starts(started)) == 1
    verdict = kept(GPU, "bf16", MODEL)
    assert verdict is not None and not verdict.failed and verdict.milliseconds["fused"] == {"total": 20.0}
    assert (verdict.stages[0].figures, verdict.device_bytes) == ({"barrier us": 1.2}, 7)
    assert "right" in backends.choose(GPU, "bf16", MODEL)[1] and verdict.issue(Path("f")) is None
    child(RIGHT.replace('taken="fused"', 'taken="cuda_graph"'))
    qualify(GPU, "bf16", MODEL)
    assert backends.choose(GPU, "bf16", MODEL)[0] == "cuda_graph"


def test_hoppers_kernels_are_qualified_in_every_precision(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    properties = SimpleNamespace(name="NVIDIA H20", major=9, minor=0, multi_processor_count=78, total_memory=96 << 30)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.delenv("TURBOPI_KERNELS", raising=False)
    kernels = [qualification.about(GPU, one, MODEL)["kernels"] for one in ("bf16", "fp8", "int8")]
    assert kernels == ["hopper"] * 3


@pytest.mark.parametrize("what", ["_driver", "_kernels_hash", "_versions"])
def test_another_driver_version_or_kernel_qualifies_anew(
    what: str, child: Child, started: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    child(RIGHT)
    chosen()
    monkeypatch.setattr(qualification, what, lambda: (("torch", "9"),) if what == "_versions" else "another")
    chosen()
    assert len(starts(started)) == 2
    chosen("fp8")
    assert len(starts(started)) == 3, "and another precision"


def test_a_known_gpu_and_a_cpu_are_never_qualified(
    child: Child, started: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    child(RIGHT)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "NVIDIA H200")
    assert chosen() == "fused" and qualification.excluded(GPU, "bf16", MODEL) == {}
    backends.qualified(torch.device("cpu"), "bf16", MODEL)
    assert starts(started) == []
    monkeypatch.setenv(qualification.UNKNOWN_VARIABLE, "1")
    chosen()
    assert len(starts(started)) == 1
    monkeypatch.setenv(qualification.UNKNOWN_VARIABLE, "yes")
    with pytest.raises(ConfigError, match=r"TURBOPI_UNKNOWN_GPU is 'yes'; expected '1'"):
        chosen()


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("hang()", "the denoising kernel said nothing for 0 s, as if it waited for ever"),
        ("os.abort()", "the denoising kernel: the process ended with code -6"),
        ('say(failed="CUDA error: illegal memory access"); sys.exit(1)', "the denoising kernel: CUDA error: illegal"),
    ],
)
def test_what_a_process_hangs_or_dies_of_is_excluded_where_there_is_another_path(
    fault: str, why: str, child: Child, started: Path
) -> None:
    child(f'say(at="the denoising kernel", path="denoise", quiet=0.2)\nif not excluded: {fault}\n{RIGHT}')
    assert chosen() == "fused" and starts(started) == ["", "denoise"]
    verdict = kept(GPU, "bf16", MODEL)
    assert verdict is not None and verdict.excluded[DENOISE].startswith(why)
    assert dict(qualification.excluded(GPU, "bf16", MODEL)) == verdict.excluded, "which the backend asks"
    file = file_of(GPU, "bf16", MODEL)
    assert str(verdict.issue(file)).endswith(f"attach the file that `turbopi doctor --qualify` wrote: {file}")


def test_without_another_path_bf16_goes_on_and_fp8_is_refused_in_words(child: Child) -> None:
    child('say(at="the model\'s sizes", quiet=9.0)\nprint("said so", file=sys.stderr)\nsay(failed="actions are off")')
    assert chosen() == "cuda_graph"
    verdict = kept(GPU, "bf16", MODEL)
    assert verdict is not None and verdict.failed and verdict.log == "said so\n"
    assert (
        "not fused: tested on this GPU: its self-test failed: the model's sizes: actions are off"
        in (backends.choose(GPU, "bf16", MODEL)[1])
    )
    with pytest.raises(BackendUnavailable, match=r"fp8 can't run on NVIDIA Fake: its .*; take precision 'bf16'"):
        chosen("fp8")
    with pytest.raises(BackendUnavailable, match=r"attach the file that `turbopi doctor --qualify` wrote: .*json"):
        chosen("fp8")


def test_a_path_that_fails_again_is_no_other_path(child: Child, started: Path) -> None:
    child('say(at="a batch of two", path="batch", quiet=9.0)\nos._exit(3)')
    assert chosen() == "cuda_graph" and starts(started) == ["", "batch"]


def test_time_is_up_at_most_twice_and_then_doctor_is_named(
    child: Child, started: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    child('say(at="cuda_graph at full size", quiet=99.0)\nhang()')
    monkeypatch.setattr(qualifying, "SECONDS", 0.5)
    assert [chosen() for _ in range(4)] == ["cuda_graph"] * 4 and len(starts(started)) == qualifying.TURNS
    why = backends.choose(GPU, "bf16", MODEL)[1]
    assert "time was up at cuda_graph at full size; `turbopi doctor --qualify` takes up to 600 s" in why
    assert chosen("fp8") == "fused", "nothing is wrong with it"


def test_time_that_is_up_behind_the_race_leaves_its_result(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    child(RIGHT.replace("say(done=True)", 'say(at="the shipped policy", quiet=99.0)\nhang()'))
    monkeypatch.setattr(qualifying, "SECONDS", 0.7)
    assert chosen() == "fused"
    verdict = kept(GPU, "bf16", MODEL)
    assert verdict is not None and verdict.reason == "right; time was up at the shipped policy"
    assert verdict.unfinished == 0 and verdict.milliseconds["fused"] == {"total": 20.0}


@pytest.mark.parametrize("fault", ['say(at="a", failed="out of memory", transient=True); sys.exit(1)', "sys.exit(9)"])
def test_a_reason_that_may_be_gone_next_time_is_not_kept(fault: str, child: Child, started: Path) -> None:
    child(fault)
    assert chosen() == chosen() == "cuda_graph" and len(starts(started)) == 1, "this process knows"
    assert not file_of(GPU, "bf16", MODEL).exists()
    qualification._UNKEPT.clear()
    child(RIGHT)
    assert chosen() == "fused"


def test_a_process_that_can_not_be_started_is_no_fault_of_the_gpu(
    child: Child, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(qualifying, "_command", lambda: ["/nowhere/python"])
    assert chosen() == "cuda_graph"
    assert "no process could be started" in backends.choose(GPU, "bf16", MODEL)[1]


def test_without_a_cache_the_verdict_holds_for_this_process(
    child: Child, started: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(qualification, "cache_folder", lambda: tmp_path / "file")
    child(RIGHT)
    assert chosen() == chosen() == "fused" and len(starts(started)) == 1


def test_a_damaged_verdict_is_made_again(child: Child, started: Path, caplog: pytest.LogCaptureFixture) -> None:
    child(RIGHT)
    chosen()
    file = file_of(GPU, "bf16", MODEL)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"taken": "tensorrt"}))
    assert chosen() == "fused" and len(starts(started)) == 2
    assert "taken is 'tensorrt'" in caplog.text


def test_a_verdict_names_no_user(child: Child) -> None:
    child(f'say(at="kernels", quiet=9.0)\nprint({str(Path.home())!r} + "/code.py", file=sys.stderr)\nsay(failed="no")')
    assert chosen() == "cuda_graph"
    assert "~/code.py" in file_of(GPU, "bf16", MODEL).read_text()


def test_known_gpus_are_those_with_checked_in_results() -> None:
    results = Path(__file__).parents[1] / "benchmarks" / "results"
    measured = "".join(file.read_text() for file in results.rglob("*.json"))
    for name in qualification.KNOWN:
        assert re.search(rf'"name": ?"{re.escape(name)}"', measured)


def test_processes_that_want_the_same_take_turns(child: Child, started: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    child(RIGHT)
    theirs, file = qualify(GPU, "bf16", MODEL), file_of(GPU, "bf16", MODEL)
    text, other, waited = file.read_text(), ExitStack(), list[str]()
    file.unlink()
    other.enter_context(alone_in(file.parent, "a test"))
    monkeypatch.setattr(time, "sleep", lambda seconds: None)

    def tell(at: str, done: int) -> None:
        waited.append(at)
        file.write_text(text)  # by the process that has the turn, which ends
        other.close()

    assert qualify(GPU, "bf16", MODEL, tell=tell) == theirs
    assert waited == ["another process qualifies this GPU"] and len(starts(started)) == 1
    with alone_in(file.parent, "a test"):
        late = qualify(GPU, "bf16", MODEL, seconds=0)
    assert (late.taken, late.failed) == ("cuda_graph", False) and "another process" in late.reason


@pytest.mark.slow
def test_nothing_is_imported_that_a_machine_may_lack() -> None:
    code = "import sys, turbopi.backends.qualification; sys.exit('triton' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.slow
def test_the_process_itself_says_all_of_it(child: Child, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU: PyTorch's backend stands for `fused`."""
    child("")
    monkeypatch.setattr(qualifying, "_command", lambda: [sys.executable, "-m", "turbopi.qualify"])
    monkeypatch.setenv("PYTHONPATH", ":".join([str(Path(__file__).parent), str(Path(backends.__file__).parents[2])]))
    monkeypatch.setenv(qualifying.DOUBLE_VARIABLE, "qualify_on_cpu")
    said: list[tuple[str, int]] = []
    verdict = qualify(GPU, "bf16", TWO_LAYERS.model, seconds=900, tell=lambda *one: said.append(one))
    assert not verdict.failed and not verdict.excluded and verdict.log == "", verdict
    assert [one.name for one in verdict.stages] == [*STAGES[:3], STAGES[4]]  # no shipped policy is of these sizes
    assert verdict.stages[0].figures == {"barrier us": 1.25}
    assert set(verdict.milliseconds) == {"fused", "cuda_graph"} and verdict.taken in verdict.milliseconds
    assert verdict.reason.startswith("right; fused ") and {at for at, _ in said} >= {"float32 reference", "kernels"}
    assert qualification.kept(GPU, "bf16", TWO_LAYERS.model) == verdict
