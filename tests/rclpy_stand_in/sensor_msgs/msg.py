from dataclasses import dataclass, field

from builtin_interfaces.msg import Time


@dataclass
class Header:
    stamp: Time = field(default_factory=Time)


@dataclass
class Image:
    height: int
    width: int
    encoding: str
    step: int
    data: bytes
    header: Header = field(default_factory=Header)


@dataclass
class JointState:
    name: list[str]
    position: list[float]
    header: Header = field(default_factory=Header)
