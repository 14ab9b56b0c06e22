"""Between a policy and a robot's control loop: actions at the control rate while the policy computes.

    with RealTimeExecutor(policy, control_hz=50, execution="rtc") as executor:
        executor.warm_up(robot.observation())
        while robot.running():                             # at 50 Hz
            executor.observe(robot.observation())          # from any thread
            command = executor.next_action()               # never waits for the policy
            if command.action is not None:
                robot.send(command.action)
    executor.report(plot="run.png")

Needs NumPy alone, and matplotlib for the plot: docs/real_time.md.
"""

from turbopi.realtime.executor import RealTimeExecutor
from turbopi.realtime.journal import Command, Inferred, OutOfActions

__all__ = ["Command", "Inferred", "OutOfActions", "RealTimeExecutor"]
