"""Reuse of keys and values in a simulator: cells of `kv_reuse` on LIBERO, or any other simulator of `turbopi eval`."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from torch import Tensor

from turbopi.backends.pytorch import reference_model
from turbopi.evaluate.sources import PolicySource
from turbopi.support.files import append_line, whole_lines
from turbopi_lab.studies.answering import Requested
from turbopi_lab.studies.kv_reuse import CLAIMED, NOTHING, Reuse, Reusing, speed_ups
from turbopi_lab.studies.simulated import PLAIN, Given, Variant, Variants, open_plain

FILE = "reused.jsonl"  # in a cell's folder: [task, initial state, call, share of image tokens that it reused]
ANOTHERS = "every 2, of another episode"
CELLS = (  # in two episodes of LIBERO cosines of two calls' images were from 0.86 to 0.94, half of them above 0.90
    *(Reuse("full", 0.985), Reuse("full", 0.92), Reuse("full", 0.9), Reuse("full", 0.87)),
    *(Reuse("patch", 0.985), Reuse("patch", 0.95), Reuse("patch", 0.9), Reuse("every", 2)),
)


@contextmanager
def _open(given: Given, reuse: Reuse, roll: int = 0) -> Iterator[PolicySource]:
    policy = given.policy()
    reusing = Reusing(reference_model(policy.backend), reuse, roll, compare=False)

    def answer(requested: Requested) -> Tensor:
        reusing.shares.clear()
        chunk = reusing.answer(
            requested.observation, requested.noise, requested.steps, requested.episodes, requested.numbers
        )
        rows = zip(requested.episodes, requested.numbers, reusing.shares, strict=True)
        lines = [json.dumps([*episode, number, share]) for episode, number, share in rows]
        append_line(given.folder / FILE, "\n".join(lines))
        return chunk

    yield given.answered(policy, answer)


def reused(folder: Path) -> tuple[float, float] | None:
    """Share of the image tokens that a cell reused, and of the calls that reused all; None if it tells nothing.

    Of an episode that was run again, its last calls count.
    """
    if not (folder / FILE).exists():
        return None
    shares: dict[tuple[int, int], list[float]] = {}
    for line in whole_lines(folder / FILE):
        task, state, number, share = json.loads(line)
        shares[task, state] = [*shares.get((task, state), [])[:number], share]
    if not shares:
        return None
    every = np.concatenate(list(shares.values()))
    return float(every.mean()), float((every == 1).mean())


def _name(reuse: Reuse) -> str:
    return f"{reuse.what} {reuse.value:g}"


def _measured(name: str, folder: Path) -> dict[str, float]:
    found, reuse = reused(folder), next((one for one in CELLS if _name(one) == name), None)
    if found is None:
        return {}
    shares = {"tokens reused, %": 100 * found[0], "calls that reuse all, %": 100 * found[1]}
    return shares if reuse is None else shares | {"speed-up by stages' times": speed_ups(reuse, *found)[1]}


def _variant(reuse: Reuse) -> Variant:
    return Variant(_name(reuse), partial(_open, reuse=reuse), reuse.what)


VARIANTS = Variants(
    name="kv_reuse_libero",
    question="Can the prefix's keys and values be reused on LIBERO while images look alike?",
    claimed=CLAIMED,
    cells=[*map(_variant, CELLS), Variant(ANOTHERS, partial(_open, reuse=Reuse("every", 2), roll=1))],
    few=["full 0.9", "every 2"],
    neutral=_variant(Reuse("full", NOTHING)),
    exact=True,
    broken=ANOTHERS,
    method=(
        "Image tokens are reused while their cosine to those that were last computed is at least θ: all together, or "
        "token by token; every 2: all keys and values in every second call. Speed-ups are arithmetic, by the times of "
        "the stages of `fused` on an H200."
    ),
    would_change="Images that stand still for long while the policy needs no answer; a policy that reads the state.",
    x_label="image tokens reused, %",
    plain=Variant(PLAIN, open_plain, x=0),
    measured=_measured,
)
STUDY = VARIANTS.study
