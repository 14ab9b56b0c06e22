"""What the errors say, in words that claim no more than they show."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from turbopi.replay.compare import HELD, MEAN, NEVER_MOVED, OTHERS, Compared
from turbopi.replay.document import Changed, Control, Level, PolicyDocument, State, Verdict
from turbopi.replay.run import broken_text
from turbopi.support.text import significant

FOLLOWS, PARTLY = 0.5, 0.8  # of the error of a chunk that knows nothing of the moment
LEAST = 5  # moments that are judged
DEGREES = 180 / np.pi
NO_SUCCESS_RATE = (
    "It isn't a success rate: how often the robot succeeds, only the robot shows. Recorded actions aren't the only "
    "right ones, either."
)


def judge(
    one: Compared, document: PolicyDocument, controls: Sequence[Control], states: Sequence[State], prompt: str
) -> Verdict:
    """Whether the chunks follow what was recorded, and if not, what shows why."""
    values = {control.name: control.relative for control in controls}
    knowing_nothing = [values[name] for name in (OTHERS, MEAN) if name in values]
    error, moments = document.relative.mean, len(one.by_moment)
    if moments < LEAST or not knowing_nothing:
        text = f"Too few moments to judge: {moments}. Take more episodes, or a smaller --every."
        return Verdict("too few", text, [*_hints(one, document, states, "too few"), *_of_broken(one)])
    lowest, held = min(knowing_nothing), values.get(HELD, np.inf)
    share = error / lowest if lowest > 0 else np.inf
    level: Level = "differs" if share > PARTLY else "partly" if share > FOLLOWS or error > held else "follows"
    beside = ", ".join(f"{significant(value)} of {name}" for name, value in values.items())
    opening = {
        "follows": "The chunks follow the recorded actions",
        "partly": "The chunks follow the recorded actions in part",
        "differs": "The chunks don't follow the recorded actions",
    }[level]
    text = f"{opening}: their error is {significant(error)}, beside {beside}. {NO_SUCCESS_RATE}"
    hints = list(_hints(one, document, states, level))
    if level == "differs" and one.run.about.get("random_weights"):
        hints = ["The weights are random: no other result could be expected."]
    elif level == "differs" and not hints:
        hints = [
            "Nothing in the numbers shows why. Look at, in this order: is it the checkpoint of this task, with its "
            "own --config and statistics (`turbopi inspect`)? Is each camera the right one (the keys above, "
            f"--rename)? Is the prompt the training's (“{prompt}”, --task)? Are the actions of the same kind: "
            "positions or differences, joints or end effector?"
        ]
    return Verdict(level, text, [*hints, *_of_broken(one)])


def _of_broken(one: Compared) -> Iterator[str]:
    broken, answered = one.run.broken, len(one.by_moment)
    if broken:
        yield (
            f"{len(broken)} of {len(broken) + answered} answers are no chunk that a robot may be given, and are left "
            f"out of the errors: there the robot would hold. The first: {broken_text(broken[0])}"
        )


def _hints(one: Compared, document: PolicyDocument, states: Sequence[State], level: Level) -> Iterator[str]:
    yield from _of_units(one, states, level in ("partly", "differs"))
    yield from _of_changes(document.changed)
    if level in ("partly", "differs"):
        yield from _of_joints(one, document)


# --- units and statistics ---------------------------------------------------------------------------------------------


def _of_units(one: Compared, states: Sequence[State], wrong: bool) -> Iterator[str]:
    """Numbers that the training hadn't: degrees for radians, other statistics; only if the chunks are `wrong` also
    radians for degrees, as a robot that hardly moves has such numbers, too.
    """
    run = one.run
    low, high = run.state_range
    if len(low):
        numbers = run.states[:, : len(low)]
        moving, middle = (high - low) / 2 > NEVER_MOVED, (high + low) / 2
        half = np.where(moving, (high - low) / 2, 1)
        outside = [state for state in states if state.outside]
        found = _converted(lambda factor: (factor * numbers - middle) / half, moving, wrong)
        if found is not None:
            yield (
                f"The states look as if they were in {found}. Convert them where they are recorded, or in a robot of "
                "your own."
            )
        elif outside:
            shown = "; ".join(_range_of(state.name, state.recorded, state.trained) for state in outside[:3])
            more = f"; {len(outside) - 3} more" if len(outside) > 3 else ""
            yield (
                f"States are outside of the checkpoint's statistics: {shown}{more}. Are these its statistics, and is "
                "this its robot?"
            )
    recorded = run.recorded.reshape(-1, run.recorded.shape[2])
    low, high = np.repeat(run.ends, run.recorded.shape[1], 1)
    middle, moving = (high + low) / 2, ((high - low) / 2 > NEVER_MOVED).all(0)
    half = np.where(moving, (high - low) / 2, 1)
    found = _converted(lambda factor: (factor * recorded - middle) / half, moving, wrong)
    if found is not None:
        yield f"The recorded actions look as if they were in {found}."
        return
    inside = np.abs(recorded - middle) / half
    far = [i for i in np.flatnonzero(moving) if np.nanpercentile(inside[:, i], 90) > 2]
    if far:
        yield (
            f"Recorded actions are outside of the checkpoint's statistics ({len(far)} of {int(moving.sum())} "
            "dimensions, the table shows which): its statistics are of other data, or these are actions of another "
            "kind or unit."
        )


def _range_of(name: str, recorded: tuple[float, float], trained: tuple[float, float] | None) -> str:
    training = "" if trained is None else f", in training {trained[0]:.3g} to {trained[1]:.3g}"
    return f"{name} {recorded[0]:.3g} to {recorded[1]:.3g}{training}"


def _converted(normalised: Callable[[float], np.ndarray], moving: np.ndarray, small: bool) -> str | None:
    """ "degrees …" if numbers [n, d] fit the training's range converted, and as they are don't.

    normalised   factor -> the numbers times that, of which the training's are in [-1, 1]
    small        whether radians for degrees are looked for, too
    """
    if not moving.any() or _fits(normalised(1.0)[:, moving]):
        return None
    if _fits(normalised(1 / DEGREES)[:, moving]):
        return "degrees, and the checkpoint was trained on radians"
    if small and _fits(normalised(DEGREES)[:, moving]):
        return "radians, and the checkpoint was trained on degrees"
    return None


def _fits(values: np.ndarray) -> bool:
    """Whether numbers fill a training's range [-1, 1] as recorded ones do: within it, and not all in one place."""
    values = values[np.isfinite(values).all(1)]
    if not len(values):
        return False
    within = (np.abs(values) <= 1.5).mean()
    low, high = np.percentile(values, [1, 99], axis=0)
    return bool(within >= 0.9 and np.median(high - low) >= 0.1)


# --- inputs -----------------------------------------------------------------------------------------------------------


def _of_changes(changed: Sequence[Changed]) -> Iterator[str]:
    for one in changed:
        if one.moments >= 4 and one.relative < 0.85 * one.as_recorded and one.nearer >= 0.8 * one.moments:
            yield (
                f"With {one.name} the error falls from {significant(one.as_recorded)} to {significant(one.relative)} "
                f"(nearer at {one.nearer} of {one.moments} moments): the dataset seems to have them the other way "
                "round."
            )


def _of_joints(one: Compared, document: PolicyDocument) -> Iterator[str]:
    """Actions in another order, with another sign, or of another scale: they go together, but not as they should."""
    joints = document.joints
    predicted, recorded = one.run.moved
    there = np.isfinite(recorded).all(2)
    predicted, recorded = predicted[there], recorded[there]
    moving = [i for i, joint in enumerate(joints) if joint.correlation is not None]
    if len(predicted) < 10 or not moving:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        table = np.corrcoef(predicted[:, moving].T, recorded[:, moving].T)[: len(moving), len(moving) :]
    own = np.diag(table)
    turned = [joints[i].name for i, value in zip(moving, own, strict=True) if value < -0.8]
    if turned:
        yield (
            f"Predicted and recorded go against each other in {', '.join(turned)}: is its sign another one in this "
            "data?"
        )
    best = table.argmax(1)
    for row, column in enumerate(best):
        if row != column and table[row, column] > 0.8 and own[row] < 0.4 and table[column, column] < 0.4:
            yield (
                f"What is predicted of {joints[moving[row]].name} goes with what was recorded of "
                f"{joints[moving[column]].name}: is the order of the actions another one?"
            )
    slopes = [
        float(np.polyfit(predicted[:, i], recorded[:, i], 1)[0])
        for i, value in zip(moving, own, strict=True)
        if value > 0.8
    ]
    if slopes and 2 * len(slopes) >= len(moving) and not 0.4 < (middle := float(np.median(slopes))) < 2.5:
        yield (
            f"Recorded actions go with the predicted ones, but are {middle:.3g} times as large: another unit, or other "
            "statistics?"
        )
