from dataclasses import dataclass, field

from builtin_interfaces.msg import Duration


@dataclass
class JointTrajectoryPoint:
    positions: list[float] = field(default_factory=list)
    time_from_start: Duration = field(default_factory=Duration)

    def __post_init__(self) -> None:
        assert all(type(value) is float for value in self.positions)


@dataclass
class JointTrajectory:
    joint_names: list[str] = field(default_factory=list)
    points: list[JointTrajectoryPoint] = field(default_factory=list)
