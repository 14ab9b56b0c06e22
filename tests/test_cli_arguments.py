"""Arguments that nobody means: one line and exit code 2, before any work."""

import builtins
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi

from turbopi.cli.files import check_folder
from turbopi.support.errors import ConfigError

TINY = ("--random-weights", "pi05_tiny")
PLAN = ("plan", "--hz", "50", "--horizon", "50")
NOWHERE = ("--observations", "there/is/no/such/recording")  # refused late: what is refused first is another thing


def one_line(*arguments: object) -> str:
    """What is said of bad arguments: typer's usage, or one line, last on stderr."""
    result = turbopi(*arguments)
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    assert "Traceback" not in result.output + result.stderr
    assert "error: " in result.stderr or "Usage:" in result.stderr
    if "Usage:" in result.stderr:
        return " ".join(result.stderr.split())
    *_, last = result.stderr.splitlines()
    assert last.startswith("error: "), result.stderr
    assert len(last) < 1000
    return last


HUGE = str(10**30)
NUMBERS: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    (("bench", *TINY, "--steps"), ("0", "-1", "1001", HUGE, "", "x", "1,,2", "9" * 5000)),
    (("bench", *TINY, "--cameras"), ("0", "4", HUGE)),
    (("bench", *TINY, "--prompt-tokens"), ("0", "8193", HUGE)),
    (("bench", *TINY, "--image-size"), ("0x3", "640", "640x", "8193x1", "640x480,", "-1x3", HUGE)),
    (("bench", *TINY, "--horizons"), ("0", "1001", HUGE)),
    (("bench", *TINY, "--calls"), ("0", HUGE, "nan")),
    (("bench", *TINY, "--batch"), ("0", "1025", "x", HUGE)),
    ((*PLAN, "--gpu", "h200", "--robots"), ("0", "10001", "x", HUGE)),
    ((*PLAN, "--robots", "1", "--gpu", "h200", "--delay-steps"), ("0", "26", HUGE)),
    ((*PLAN, "--robots", "1", "--gpu", "h200", "--execution-horizon"), ("0", "51", HUGE)),
    ((*PLAN, "--robots", "1", "--gpu", "h200", "--overhead-ms"), ("-1", "nan", "60000", HUGE)),
    ((*PLAN, "--robots", "1", "--gpu", "h200", "--precision"), ("", "fp7", "f32")),
    (("bench", *TINY, "--main-calls"), ("0", HUGE)),
    (("bench", *TINY, "--seconds"), ("-1", "nan", "x")),
    (("calibrate", *TINY, *NOWHERE, "--out", "never.json", "--count"), ("1", "-1", HUGE)),
    (("calibrate", *TINY, *NOWHERE, "--out", "never.json", "--noises"), ("0", HUGE)),
    (("calibrate", *TINY, *NOWHERE, "--out", "never.json", "--steps"), ("0", HUGE)),
    (("calibrate", *TINY, *NOWHERE, "--out", "never.json", "--batch"), ("0", HUGE)),
    (("calibrate", *TINY, *NOWHERE, "--out", "never.json", "--target"), ("-0.1", "1.1", "nan", "inf")),
    (("calibrate", *TINY, *NOWHERE, "--out", "never.json", "--seed"), ("-1", "1.5")),
    (("verify", *TINY, *NOWHERE, "--noises"), ("0", HUGE)),
    (("verify", *TINY, *NOWHERE, "--bound"), ("nan",)),
    (("verify", *TINY, *NOWHERE, "--factor"), ("nan",)),
    (("replay", "nothing", *TINY, "--every"), ("0", "-1", "x", HUGE)),
    (("replay", "nothing", *TINY, "--changed"), ("-1", "1001", "nan")),
    (("replay", "nothing", *TINY, "--episodes"), ("", "x", "3-1", HUGE)),
    (("study", "throughput", *TINY, "--calls"), ("0", HUGE)),
    (("study", "throughput", *TINY, "--steps"), ("0", HUGE)),
    (("serve", *TINY, "--port"), ("-1", "65536", HUGE, "")),
    (("serve", *TINY, "--max-message-mb"), ("0", "-1", "nan", "inf", "1e400")),
    (("serve", *TINY, "--queue-limit"), ("-1", "x")),
    (("serve", *TINY, "--max-clients"), ("0", "-1")),
    (("inspect", *TINY, "--weights-seed"), ("-1", str(2**32), HUGE, "x")),
    (("demo", *TINY, "--frames"), ("0", "-1")),
    (("demo", *TINY, "--episodes"), ("-1", "21", HUGE)),
    (("demo", *TINY, "--steps"), ("0", "1001", HUGE)),
]


@pytest.mark.parametrize(
    ("arguments", "value"),
    [(arguments, value) for arguments, values in NUMBERS for value in values],
    ids=lambda part: part[:20] if isinstance(part, str) else f"{part[0]} {part[-1]}",
)
def test_numbers_that_cannot_be_meant_are_refused_before_any_work(arguments: tuple[str, ...], value: str) -> None:
    said = one_line(*arguments, value)
    assert arguments[-1].lstrip("-").split("-")[-1] in said or "steps" in said or "seed" in said


@pytest.mark.slow
@pytest.mark.parametrize("command", [("inspect",), ("infer",), ("convert",), ("serve", "--port", "0")], ids=str)
@pytest.mark.parametrize("kind", ["missing", "file", "folder", "loop", "long", "below a file", "empty", "odd bytes"])
def test_what_is_no_checkpoint_is_named(command: tuple[str, ...], kind: str, tmp_path: Path) -> None:
    place = {
        "missing": tmp_path / "missing",
        "file": tmp_path / "file",
        "folder": tmp_path / "folder",
        "loop": tmp_path / "loop",
        "long": tmp_path / ("x" * 300),
        "below a file": tmp_path / "file" / "x",
        "empty": Path(),
        "odd bytes": tmp_path / "\udcff",
    }[kind]
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    observation = tmp_path / "observation.npz"
    np.savez(observation, prompt="x")
    wanted: dict[str, list[object]] = {"infer": [observation, "--no-plot"], "convert": [tmp_path / "new"]}
    others = wanted.get(command[0], [])
    said = one_line(*command[:1], "" if kind == "empty" else place, *others, *command[1:])
    if kind not in ("empty", "long"):
        assert place.name.encode("utf-8", "backslashreplace").decode() in said or place.name in said
    assert not (tmp_path / "new").exists()


def test_a_file_that_may_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As for users other than root."""
    assert turbopi("convert", *TINY, tmp_path / "tiny").exit_code == 0
    real = builtins.open

    def opening(path: Any, *arguments: Any, **options: Any) -> Any:
        if str(path).endswith("turbopi.json"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, *arguments, **options)

    monkeypatch.setattr(builtins, "open", opening)
    said = one_line("convert", tmp_path / "tiny", tmp_path / "new")
    assert str(tmp_path / "tiny" / "turbopi.json") in said
    assert "Permission denied" in said


def test_a_folder_that_may_not_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(**options: Any) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "mkdtemp", refusing)
    no = f"{tmp_path} isn't writable (Permission denied)"
    assert no in one_line("calibrate", *TINY, "--out", tmp_path / "fp8.json")
    assert no in one_line("infer", *TINY, tmp_path / "no.npz", "--out", tmp_path / "actions.npz")
    assert no in one_line("serve", *TINY, "--port", 0, "--record", tmp_path)
    assert no in one_line("eval", "reacher", *TINY, "--out", tmp_path)
    assert no in one_line("demo", *TINY, "--report", tmp_path)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc here")
def test_a_folder_that_can_not_be_made_is_refused_before_the_work_to_root_too() -> None:
    """Root may write everywhere, says `os.access`."""
    no = "can't write into /proc/x: /proc takes no such folder ("
    assert no in one_line("serve", *TINY, "--port", 0, "--record", "/proc/x")
    assert no in one_line("eval", "reacher", *TINY, "--record", "/proc/x")
    assert "can't write /proc/x.npz: /proc isn't writable (" in one_line("infer", *TINY, "no.npz", "-o", "/proc/x.npz")


def test_a_folder_that_could_be_made_is_not_there_after_the_check(tmp_path: Path) -> None:
    check_folder(tmp_path / "new" / "below")
    (tmp_path / "mine").mkdir()
    check_folder(tmp_path / "mine")
    check_folder(tmp_path / "mine" / "below")
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=rf"can't write into {tmp_path}/link: {tmp_path} takes no such folder"):
        check_folder(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize("option", ["--config", "--robot", "--tokenizer", "--quantization", "--noise"])
@pytest.mark.parametrize("content", [None, b"", b"\x00\xff" * 100, b"[" * 100_000, b"[]", b"null"], ids=repr)
def test_a_file_that_is_not_what_an_option_wants_is_named(option: str, content: bytes | None, tmp_path: Path) -> None:
    file = tmp_path / "given.json"
    if content is None:
        file.mkdir()
    else:
        file.write_bytes(content)
    observation = tmp_path / "observation.npz"
    camera_image = np.zeros((8, 8, 3), np.uint8)
    seen: dict[str, Any] = {
        "observation/image": camera_image,
        "observation/wrist_image": camera_image,
        "observation/state": np.zeros(8),
    }
    np.savez(observation, prompt="x", **seen)
    weights = ("tests/golden/checkpoints/nowhere",) if option == "--config" else TINY
    more = ("--precision", "fp8", "--backend", "emulated_fp8") if option == "--quantization" else ()
    said = one_line("infer", *weights, observation, "--no-plot", "-o", tmp_path / "a.npz", option, file, *more)
    assert "given.json" in said or option == "--config"
