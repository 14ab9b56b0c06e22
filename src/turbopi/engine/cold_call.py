"""What a strict backend refuses."""

from collections.abc import Iterable

from turbopi.support.errors import ObservationError


def not_warm(
    name: str, needs: str, warm: Iterable[str], *, conditioned: bool = False, **arguments: int
) -> ObservationError:
    """Why a strict backend refuses a call.

    needs        the call's shape
    warm         the shapes that are covered
    conditioned  whether its loop is a conditioned one
    arguments    what `UnifiedPolicy.warmup` is to be given
    """
    covered = "; ".join(sorted({*warm})) or "nothing yet"
    given = ", ".join(f"{argument}={value}" for argument, value in arguments.items())
    how = " with their real_time modes or conditionings" if conditioned else ""
    return ObservationError(
        f"strict: this call needs {needs}, which backend {name!r} would have to prepare within the call. Warm is: "
        f"{covered}. Call policy.warmup({given}){how} before the robot moves"
    )
