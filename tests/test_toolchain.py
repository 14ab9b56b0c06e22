"""Folders that compilers write to."""

import os
from pathlib import Path

import pytest

from turbopi.support.toolchain import make_caches_writable

TRITON, INDUCTOR = "TRITON_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR"


@pytest.fixture(autouse=True)
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in (TRITON, INDUCTOR, "TRITON_HOME"):
        monkeypatch.setenv(variable, "")  # taken back behind the test, whoever sets it
    monkeypatch.setenv("HOME", str(tmp_path))


def test_caches_that_can_be_made_stay_where_they_are(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_caches_writable()
    assert os.environ[TRITON] == os.environ[INDUCTOR] == "" and not caplog.messages
    assert list(tmp_path.iterdir()) == [], "nothing is made on trial"


@pytest.mark.parametrize("variable", ["HOME", "TRITON_HOME", TRITON, INDUCTOR])
def test_a_cache_that_cannot_be_made_goes_to_a_temporary_folder_with_one_line_of_the_log(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(variable, str(tmp_path / "file" / "below"))
    cache = INDUCTOR if variable == INDUCTOR else TRITON
    for _ in range(2):
        make_caches_writable()
    assert Path(os.environ[cache]).is_dir() and not Path(os.environ[cache]).is_relative_to(tmp_path / "file")
    (line,) = caplog.messages
    assert str(tmp_path / "file" / "below") in line and cache in line
