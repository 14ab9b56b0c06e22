"""What a host's own sockets take."""

import pytest
from load_test import loopback
from load_test.loopback import WARM_UP, main, round_trips


def test_every_counted_round_trip_is_told_and_whole_messages_travel() -> None:
    """More bytes than a socket holds at once, either way."""
    found = round_trips(request=3_000_001, answer=2_000_001, work_s=0.0, count=3)
    assert len(found) == 3 and min(found) > 0 and WARM_UP > 0


def test_the_work_isnt_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shortest trip, as a busy host is late for some."""
    monkeypatch.setattr(loopback, "WARM_UP", 0)
    assert 0 < min(round_trips(request=10, answer=10, work_s=0.3, count=3)) < 0.3


def test_the_command_tells_quantiles(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--request", "10", "--answer", "10", "--work", "0.1", "--count", "1"]) == 0
    reported = capsys.readouterr().out
    assert reported.startswith("1 round trips: median ") and "beside the work" in reported


def test_another_process_that_ends_is_told_and_not_waited_for() -> None:
    """It fails at a sleep of less than nothing."""
    with pytest.raises(ConnectionError, match="ended after 0 round trips"):
        round_trips(request=10, answer=10, work_s=-1.0, count=1)


@pytest.mark.parametrize("bad", [["--request", "0"], ["--work", "-1"], ["--count", "0"]])
def test_sizes_that_cant_be_are_refused(bad: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        main(bad)
    assert refused.value.code == 2 and "must be at least" in capsys.readouterr().err
