"""Which CUDA graphs there are for which calls: names and sizes alone, no tensors and no GPU.

One observation's call is two graphs, "vision" of so many cameras, which starts before the prompt is known, and
"answer", prefix and all denoising steps, for a bucket of prompt lengths; where noise is chosen, "denoise" of the same
bucket twice behind it. A batched call is three: "vision", "prefix" and "denoise". Its rows are packed, so its sizes are
sums over its observations. "resized" is vision of images of any size. Nothing is captured anew when images, prompt,
state or noise change.

A call of one observation with two prompts is a batched call of two observations that have the same images.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

from turbopi.engine.loops import ALONE, Loop
from turbopi.models.pi0.conditioning import Form
from turbopi.support.errors import ObservationError

BUCKET = 16  # prompt tokens: at most 15 padded rows beside 256 a camera
MAX_CAMERAS = 4  # the cache is allocated for them
Part = Literal["vision", "resized", "answer", "prefix", "denoise"]


class GraphKey(NamedTuple):
    """One graph. Of one observation "prefix" and "denoise" are the halves of "answer", for checks by a reference."""

    part: Part
    batch: int  # observations
    images: int  # valid ones of all observations together, in a batch rounded up to a multiple of its size
    float_images: bool  # LeRobot's resizing leaves the uint8 grid
    slots: int = 0  # prompt tokens of all observations, with padding; 0: the graph is for any
    loop: Loop | None = None  # None: the graph is for any
    two_prompts: bool = False  # of one observation: then `images` are counted once

    @property
    def vision(self) -> "GraphKey":
        """The vision that is in front of it."""
        return GraphKey("vision", *self[1:4])

    def __str__(self) -> str:
        what = f"{self.batch} observations with {self.images} images"
        if self.batch == 1 or self.two_prompts:
            what = f"{self.images} cameras" + (", two prompts" if self.two_prompts else "")
        slots = f" + {self.slots} tokens" if self.slots else ""
        return f"{what}{slots}" + ("" if self.loop is None else f", {self.loop}")


def bucket(tokens: int) -> int:
    """A prompt length rounded up to its bucket."""
    return max(BUCKET, -(-tokens // BUCKET) * BUCKET)


def batch_images(batch: int, cameras: Sequence[int]) -> int:
    """Images of a call for `batch` observations, of at most so many with these numbers of cameras."""
    return -(-sum(cameras) // batch) * batch


def batch_slots(batch: int, tokens: Iterable[int]) -> int:
    """Prompt tokens of all observations together, rounded up to a bucket."""
    step = BUCKET * batch
    return max(1, -(-sum(tokens) // step)) * step


def warm_graphs(
    batch: int,
    images: int,
    float_images: bool,
    loop: Loop,
    most_tokens: int,
    *,
    resizes: bool,
    two_prompts: bool = False,
    again: Sequence[Loop] = (),
) -> Iterator[GraphKey]:
    """What warm-up captures for a call of so many observations, for prompts of every length up to `most_tokens`.

    again  loops that one observation's call runs behind its own, on the same prefix
    """
    sizes = (batch, images, float_images)
    yield GraphKey("vision", *sizes)
    if resizes:
        yield GraphKey("resized", *sizes)
    step = BUCKET * batch
    slots = range(step, batch_slots(batch, [most_tokens] * batch) + 1, step)
    if batch == 1:
        yield from (GraphKey("answer", *sizes, one, loop) for one in slots)
        yield from (GraphKey("denoise", *sizes, one, other) for other in again for one in slots)
    else:
        yield from (GraphKey("prefix", *sizes, one, two_prompts=two_prompts) for one in slots)
        yield GraphKey("denoise", *sizes, loop=loop, two_prompts=two_prompts)


def groups(forms: Sequence[Form]) -> Iterator[tuple[Form, list[int]]]:
    """Which observations may share calls, and the form of their loop.

    Those with times, held actions or identity guidance by token run together with plain ones; those guided by the true
    Jacobian together with each other; those that are ALONE, alone.
    """
    by_token = [row for row, form in enumerate(forms) if form in ("plain", "tokens")]
    if by_token:
        yield "tokens" if "tokens" in forms else "plain", by_token
    for form in ("jacobian", *ALONE):
        if rows := [row for row, one in enumerate(forms) if one == form]:
            yield form, rows


def split(count: int, costs: Mapping[int, float]) -> list[int]:
    """The calls, largest first, that together hold `count` observations at the least cost.

    costs  by the number of observations that a call holds, 1 among them: how long it takes, in any unit
    """
    assert count >= 1 and 1 in costs, (count, costs)
    return list(_split(count, tuple(costs.items())))


@lru_cache(maxsize=256)  # a call waits for it before it sends its images
def _split(count: int, costs: tuple[tuple[int, float], ...]) -> tuple[int, ...]:
    best: list[tuple[float, tuple[int, ...]]] = [(0.0, ())]
    for wanted in range(1, count + 1):
        options = []
        for size, own in costs:
            cost, others = best[max(wanted - size, 0)]
            options.append((cost + own, tuple(sorted((*others, size), reverse=True))))
        best.append(min(options, key=lambda option: (round(option[0], 6), len(option[1]))))
    return best[count][1]


def cold_call(
    name: str, needs: str, warm: Iterable[str], *, conditioned: bool = False, **arguments: int
) -> ObservationError:
    """Why a strict backend refuses a call that warm-up didn't cover.

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


def cold_graph(name: str, key: GraphKey, captured: Iterable[GraphKey]) -> ObservationError:
    """`cold_call` for a graph that isn't captured."""
    needs, conditioned = str(key._replace(slots=0)), key.loop is not None and key.loop.form != "plain"
    if key.two_prompts:
        others = (str(one._replace(slots=0)) for one in captured if one.two_prompts and one.part == key.part)
        return cold_call(name, f"{needs} (give the policy its guidance, so)", others, conditioned=conditioned)
    if key.batch > 1:
        warm = batches(captured)
        return cold_call(name, needs, warm, conditioned=conditioned, batches=key.batch)
    same = (str(one._replace(slots=0)) for one in captured if (one.part, one.batch) == (key.part, 1))
    sizes = {} if key.loop is None else {"horizons": key.loop.horizon, "steps": key.loop.steps}
    return cold_call(name, needs, same, conditioned=conditioned, cameras=key.images, **sizes)


def singles(captured: Iterable[GraphKey]) -> list[str]:
    """The calls of one observation that are captured, in words."""
    return _in_words(key for key in captured if key.batch == 1 or key.two_prompts)


def batches(captured: Iterable[GraphKey]) -> list[str]:
    """The batched calls that are captured, in words."""
    return _in_words(key for key in captured if key.batch > 1 and not key.two_prompts)


def _in_words(keys: Iterable[GraphKey]) -> list[str]:
    loops = [(key, key.loop) for key in keys if key.loop is not None]
    known = {(key.batch, key.images, key.slots, one.steps, one.horizon, str(key)) for key, one in loops}
    return [text for *_, text in sorted(known)]
