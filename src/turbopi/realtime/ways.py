"""The ways to run a policy's chunks on a robot, by name."""

from dataclasses import dataclass
from typing import Literal, get_args

from turbopi.realtime.running_chunk import JoinMode
from turbopi.support.errors import ConfigError

Execution = Literal["sync", "async", "ensemble", "rtc", "rtc_identity", "rtc_trained", "warm_start", "paint"]


@dataclass(frozen=True)
class Way:
    """stands_still  no action is carried out between an observation and its chunk
    averages      the new chunk is averaged with what is left of the running one
    mode          what the policy is asked to do with the running chunk; None: it is never told of it
    """

    name: Execution
    stands_still: bool = False
    averages: bool = False
    mode: JoinMode | None = None

    @property
    def holds(self) -> bool:
        """The new chunk repeats the running one's actions up to the delay it was told, and fits to nothing else."""
        return self.mode == "rtc_trained"

    @property
    def plain_without_delay(self) -> bool:
        """With a delay of 0 a chunk is an ordinary call's, carried out from its first action on."""
        return not self.averages and self.mode in (None, "rtc_trained", "paint")


WAYS: dict[str, Way] = {
    "sync": Way("sync", stands_still=True),
    "async": Way("async"),
    "ensemble": Way("ensemble", averages=True),
    "rtc": Way("rtc", mode="rtc"),
    "rtc_identity": Way("rtc_identity", mode="rtc_identity"),
    "rtc_trained": Way("rtc_trained", mode="rtc_trained"),
    "warm_start": Way("warm_start", mode="warm_start"),
    "paint": Way("paint", mode="paint"),
}
assert tuple(WAYS) == get_args(Execution)


def way_named(name: str) -> Way:
    """Raises ConfigError for a name that isn't one."""
    if not isinstance(name, str) or name not in WAYS:
        raise ConfigError(f"execution={name!r} is no way to run; choose one of {', '.join(WAYS)}")
    return WAYS[name]
