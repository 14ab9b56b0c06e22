from dataclasses import dataclass


@dataclass
class Duration:
    sec: int = 0
    nanosec: int = 0

    def __post_init__(self) -> None:
        assert 0 <= self.nanosec < 10**9


@dataclass
class Time(Duration): ...
