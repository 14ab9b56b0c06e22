"""What numbers of eight and four bits do to actions: `python -m turbopi.studies.fp8_and_fp4 --out FILE`.

Emulated exactly in float32 (emulate.py, formats.py) on three sets of full-size weights (weights.py).
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import torch
from msgspec import Struct
from torch import Tensor

from turbopi import backends, shipped
from turbopi.calibrate.observations import Batch, batches
from turbopi.calibrate.statistics import collect
from turbopi.checkpoint import random_checkpoint
from turbopi.engine.emulate import Round, RoundedWeights, delta_cosine, relative_rms, replaced, rounded
from turbopi.examples import Example, with_noises
from turbopi.files import write_whole
from turbopi.model.reference import Pi0Model
from turbopi.model.sites import linears
from turbopi.preprocess.pipeline import Pipeline
from turbopi.preprocess.tokenizer import TINY_TOKENIZER, load_tokenizer
from turbopi.provenance import Provenance, provenance
from turbopi.quantization.directions import Rows, directions
from turbopi.quantization.fp8 import Directions
from turbopi.quantization.sites import MLP_KINDS, PARTS, Site, sites
from turbopi.reading import plain_document
from turbopi.studies.formats import attention_in_fp8, round_nvfp4
from turbopi.studies.weights import WEIGHTS, Weights, studied_checkpoint
from turbopi.wording import significant


class FormatError(Struct, frozen=True):
    """Of the actions, against float32."""

    relative_rms: float
    delta_cosine: float  # of what denoising did


class Research(Struct, frozen=True):
    """What this writes."""

    provenance: Provenance
    preset: str
    steps: int  # of denoising
    observations: int
    errors: dict[str, dict[str, FormatError]]  # by weights, then by format and place


def errors(
    model: Pi0Model, made: list[Batch], seen: list[Batch], steps: int, formats: Sequence[str] | None = None
) -> Iterator[tuple[str, FormatError]]:
    """Formats and places, all or some, each with the actions' error; weights are rounded for what `seen` have in
    common, where that is said.
    """
    noise = torch.cat([noise for _, noise in made])
    exact = _actions(model, made, steps)
    every = [site for site in sites(model.config) if site.refusal is None]
    histograms = collect(model, every, made, steps)
    scales = {site: histograms[str(site)].scale("headroom") for site in every}
    rows: dict[str, Rows] = {}
    collect(model, every, seen, steps, rows)
    common = {site: found for site in every if (found := directions(rows.pop(str(site)).rows)) is not None}

    def of(*parts: str, mlp: bool = False) -> dict[Site, float]:
        return {s: x for s, x in scales.items() if s.part in parts and (not mlp or s.kind in MLP_KINDS)}

    cases: dict[str, Callable[[], AbstractContextManager[None]]] = {
        "FP8": lambda: rounded(model, of(*PARTS)),
        "FP8, rounded for directions": lambda: rounded(model, of(*PARTS), RoundedWeights(common)),
        "FP8, vision and prefix": lambda: rounded(model, of("vision", "prefix")),
        "FP8, feed-forward of vision and prefix": lambda: rounded(model, of("vision", "prefix", mlp=True)),
        **{f"FP8, {part}": lambda part=part: rounded(model, of(part)) for part in PARTS},  # type: ignore[misc]
        "FP8 attention, vision": lambda: attention_in_fp8("vision"),
        "FP8 attention, prefix and expert": lambda: attention_in_fp8("gemma"),
        "NVFP4": lambda: in_nvfp4(model, of(*PARTS), activations=True),
        "NVFP4, weights alone": lambda: in_nvfp4(model, of(*PARTS), activations=False),
        "NVFP4, weights of the expert alone": lambda: in_nvfp4(model, of("expert"), activations=False),
        "NVFP4, rounded for directions": lambda: in_nvfp4(model, of(*PARTS), common, activations=True),
        "NVFP4, weights alone, rounded for directions": lambda: in_nvfp4(model, of(*PARTS), common, activations=False),
    }
    for name, context in cases.items():
        if formats is not None and name not in formats:
            continue
        with context():
            actions = _actions(model, made, steps)
        yield name, FormatError(relative_rms(actions, exact), delta_cosine(actions, exact, noise))


@contextmanager
def in_nvfp4(
    model: Pi0Model, scales: dict[Site, float], common: Mapping[Site, Directions] | None = None, *, activations: bool
) -> Iterator[None]:
    """For a while, these sites' products are of NVFP4 numbers, the expert's activations too if any are; weights are
    rounded for the sites' directions, if given.
    """
    held: dict[int, Tensor] = {}

    def same(x: Tensor) -> Tensor:
        return x

    def once(weight: Tensor, site: Site) -> Tensor:
        if id(weight) not in held:
            held[id(weight)] = round_nvfp4(weight, (common or {}).get(site))
        return held[id(weight)]

    inputs = round_nvfp4 if activations else same
    changes: list[tuple[torch.nn.Linear, Round, Round]] = [
        (linear, inputs, partial(once, site=site)) for site in scales for linear in linears(model, site)
    ]
    with replaced(changes):
        yield


def _observation(frame: shipped.Frame, prompt: str) -> dict[str, np.ndarray | str]:
    return {
        "observation/image": frame.base,
        "observation/wrist_image": frame.wrist,
        "observation/state": frame.state,
        "prompt": prompt,
    }


def _actions(model: Pi0Model, made: list[Batch], steps: int) -> Tensor:
    return torch.cat([model.sample(observation, noise, steps) for observation, noise in made])


def run(
    preset: str,
    device: torch.device,
    count: int,
    steps: int,
    out: Path,
    kinds: Sequence[Weights] = WEIGHTS,
    formats: Sequence[str] | None = None,
) -> Research:
    """All errors, on LIBERO pictures: by weights and format; written to `out` as they come."""
    checkpoint = shipped.with_libero_stats(random_checkpoint(preset))
    sizes = checkpoint.config.model
    tokenizer = load_tokenizer(TINY_TOKENIZER, checkpoint_dir=None, candidates=(), vocab_size=sizes.vocab_size)
    pipeline = Pipeline(checkpoint.config, checkpoint.norm_stats, tokenizer)
    frames = shipped.load_frames()
    if not 1 <= count < len(frames):
        raise SystemExit(f"--count is from 1 to {len(frames) - 1}, as other frames give the directions; it is {count}")
    examples = [  # one prompt, so that they are one batch
        Example(f"LIBERO frame {i}", *pipeline.before(_observation(frame, frames[0].prompt)))
        for i, frame in enumerate(frames)
    ]
    shape = (sizes.action_horizon, sizes.action_dim)
    made, seen = (
        [batch for _, batch in batches(with_noises(some, shape, 1, seed), 8, device)]
        for seed, some in enumerate((examples[:count], examples[count:]))
    )
    document = Research(provenance(device), preset, steps, count, errors={})
    for kind in kinds:
        model = Pi0Model.from_state(sizes, studied_checkpoint(kind, preset, device).load(device, "f32").state)
        of_kind = document.errors.setdefault(kind, {})
        for name, error in errors(model, made, seen, steps, formats):
            of_kind[name] = error
            print(
                f"{kind}: {name:42} relative rms {significant(error.relative_rms)}  cosine {error.delta_cosine:.6f}",
                flush=True,
            )
            write_whole(out, json.dumps(plain_document(document), indent=1) + "\n")
        del model
    return document


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="pi05_libero")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--count", type=int, default=2, help="observations, of 6")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--weights", choices=WEIGHTS, action="append", help="one of the three; may be given again")
    parser.add_argument("--format", action="append", help="one of what is printed; may be given again")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    device = backends.resolve_device(options.device)
    kinds = options.weights or WEIGHTS
    run(options.preset, device, options.count, options.steps, options.out, kinds, options.format)


if __name__ == "__main__":
    main()
