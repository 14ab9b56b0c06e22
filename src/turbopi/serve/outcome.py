"""What became of one observation that was to be run."""

from dataclasses import dataclass
from typing import Any, Literal

Wrong = Literal["observation", "actions", "lost", "replica", "policy", "busy", "late", "replaced", "stopping"]


@dataclass(frozen=True)
class Outcome:
    """A `result`, or what is `wrong` and the `text` about it.

    wrong    "observation": the client's fault; "actions": the model gave none that a robot may get; "lost": the device
             failed for good; "replica": a fleet's replica that had it gave no answer; "policy": anything
             else of the policy's, and `text` is the traceback. "busy", "late", "replaced" and "stopping": it got no
             turn, and `text` is what the client is told
    seconds  in the policy
    together observations in its run
    run      its run's number: observations of one run share it
    """

    seconds: float
    result: dict[str, Any] | None = None
    wrong: Wrong | None = None
    text: str = ""
    together: int = 1
    run: int = 0
