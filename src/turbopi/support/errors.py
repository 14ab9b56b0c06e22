"""Every error that Turbo-Pi raises on purpose.

    TurboPiError
    ├── ConfigError            an option, preset or turbopi.json that can't be right       (also a ValueError)
    ├── CheckpointError        a checkpoint that can't be read, or doesn't fit its config  (also a ValueError)
    ├── TokenizerError         the SentencePiece model is missing or isn't one             (also a ValueError)
    ├── CalibrationError       a calibration that isn't one, or was made for others  (also a ValueError)
    ├── ObservationError       an observation the policy can't use                         (also a ValueError)
    ├── BackendError           a backend can't do what it was asked to
    │   ├── BackendUnavailable it can't run here at all; says why and what to do
    │   └── DeviceLost         the GPU failed under it: no later call of this process can work
    ├── ActionError            a policy's answer that no robot may be given: NaN, infinite, no chunk of numbers
    ├── OutputError            a file that can't be written: a full disk, no permission        (also an OSError)
    ├── client.ServerLost                  the policy server can't be reached, went away or took too long
    ├── client.ServerRefused               it answered with something else than actions
    ├── realtime.OutOfActions              the policy is late and the robot has no action left
    ├── sim.base.SimulatorUnavailable      a simulator isn't installed or can't draw
    ├── evaluate.sources.PolicyLost        a policy server went away; the run can be continued
    ├── evaluate.sources.PolicyRefused     a policy doesn't fit the simulator
    └── evaluate.schedule.TooManyCrashes   the simulator breaks again and again

Messages name the value, what was expected, and what to do about it. Broken invariants of our own are `assert`s. As some
errors are ValueErrors, or an OSError, `except ValueError` around our own checks would catch what they raise, too.
"""


class TurboPiError(Exception):
    """Base of all errors raised on purpose."""


class ConfigError(TurboPiError, ValueError):
    """An option, preset or `turbopi.json` that can't be right."""


class CheckpointError(TurboPiError, ValueError):
    """A checkpoint that can't be read, or doesn't fit its configuration."""


class TokenizerError(TurboPiError, ValueError):
    """The SentencePiece model is missing, unreadable, or doesn't fit the model's vocabulary."""


class CalibrationError(TurboPiError, ValueError):
    """A calibration that can't be read, or was made for other weights, shapes or another version."""


class ObservationError(TurboPiError, ValueError):
    """An observation the policy can't use: a missing key, a wrong shape or dtype, a value that isn't finite."""


class BackendError(TurboPiError, RuntimeError):
    """A backend can't do what it was asked to."""


class BackendUnavailable(BackendError):
    """A backend can't run on this machine; the message says why and what to do."""


class DeviceLost(BackendError):
    """The device failed (a CUDA error that sticks to the process). Every later call fails: start the process again."""


class ActionError(TurboPiError, ArithmeticError):
    """A policy's answer that no robot may be given: a number in it is NaN or infinite, or it is no chunk of numbers."""


class OutputError(TurboPiError, OSError):
    """A file that can't be written: the disk is full or read-only, there is no permission, no such folder."""
