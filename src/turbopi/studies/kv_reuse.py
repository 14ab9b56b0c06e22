"""Reuse of the prefix's keys and values while pictures look alike: how much work does it save, at what price?

The similarity is the cosine of the vision tower's tokens now and when they were last computed, so the tower runs in
every call; only `every k-th call` saves it, too. What is reused, where the similarity is at least θ:

    full         all keys and values, of pictures and text
    per camera   a camera's tokens as they enter the language model, which runs over old and new ones
    per patch    keys and values of single image tokens, in all layers, as VLA-Cache does (Xu et al. 2025); text and
                 changed tokens are computed, and attend to old ones
    every k      all keys and values in k − 1 of k calls, whatever the pictures show

Vision alone, with text and state computed afresh, gives what `full` gives where neither text nor state changes: the
policies here have one instruction and read no state.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from msgspec import Struct
from torch import Tensor

from turbopi.bench.work import Job, stage_work
from turbopi.config import preset
from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.model.exact import exact_float32
from turbopi.model.kv_cache import EmbeddedPrefix, KVCache
from turbopi.model.layers import gated_residual, rope_tables
from turbopi.model.reference import Pi0Model
from turbopi.observation import Observation
from turbopi.reading import plain_document
from turbopi.studies.report import Cell, Control, Grid, Panel, Plot, Report, Series, paired_cell, rate_cells
from turbopi.studies.rollouts import Call, Played, ToyPolicy, open_policy, play, sampled
from turbopi.studies.study import Setup, Study, Tell

NOTHING = 1.5  # θ above any cosine: nothing is ever reused
STEPS = 5
# Milliseconds of stages and of the whole call: `fused` bf16, pi05_libero, two cameras, 48 tokens, ten steps, H200
# (benchmarks/results/h200_2026-11-24_pi05_libero/results.json)
CALL_MS = {"vision": 1.186, "prefix": 3.475, "denoise": 2.614, "total": 7.450}


@dataclass(frozen=True)
class Reuse:
    """What is reused, and when: θ, or k of `every k`."""

    what: str  # "full", "camera", "patch", "every"
    value: float

    def __str__(self) -> str:
        return f"every {self.value:.0f}" if self.what == "every" else f"{self.what}, θ = {self.value:g}"


def cells(small: bool) -> list[Reuse]:
    if small:
        return [Reuse("full", 0.9), Reuse("patch", 0.9), Reuse("camera", 0.9), Reuse("every", 2)]
    thresholds = (0.985, 0.95, 0.9, 0.8)
    found = [Reuse(what, theta) for what in ("full", "camera", "patch") for theta in thresholds]
    return found + [Reuse("every", k) for k in (2, 3, 4)]


class ReuseCell(Struct, frozen=True):
    policy: str
    reuse: str
    value: float
    rate: RateDocument
    against_plain: PairedDocument
    reused: float  # share of the image tokens, of all calls until an episode is decided, that are old
    reused_calls: float  # share of the calls in which all are
    action_error: float  # rms of the chunks' difference to fresh ones, over calls that reuse, relative to those


@dataclass
class Memory:
    """What earlier calls left, a row for each episode: tokens to compare with, embeddings, keys and values."""

    hidden: Tensor  # [B, C * T, W]
    embs: Tensor  # [B, S, D]
    k: Tensor  # [layer, B, G, S, K]
    v: Tensor

    def rows(self, rows: list[int]) -> "Memory":
        return Memory(self.hidden[rows], self.embs[rows], self.k[:, rows], self.v[:, rows])


@dataclass
class Reusing:
    """Answers calls with what `reuse` allows, and counts. `roll`: each episode has the memory of one so far away."""

    model: Pi0Model
    reuse: Reuse
    roll: int = 0
    memory: Memory | None = None
    episodes: Sequence[int] = ()  # of the memory's rows
    shares: list[float] = field(default_factory=list)  # of each episode's call: image tokens that are reused
    errors: list[tuple[float, float]] = field(default_factory=list)

    def __call__(self, call: Call) -> Tensor:
        if call.number == 0:
            self.memory = None
        elif self.memory is not None and len(call.episodes) < len(self.episodes):  # others are decided
            place = {episode: row for row, episode in enumerate(self.episodes)}
            self.memory = self.memory.rows([place[episode] for episode in call.episodes])
        self.episodes = call.episodes
        embedded, hidden = embed(self.model, call.observation)
        old = self._stale(call, hidden)
        if self.memory is None or not bool(old.any()):
            cache = self.model.keys_values(embedded)
            chunk = self.model.denoise(cache, call.noise, STEPS)
            keep = old
        else:
            cache, keep = self._reused(embedded, old), old
            chunk = self.model.denoise(cache, call.noise, STEPS)
            self._compare(call, embedded, chunk, old)
        self._remember(hidden, embedded, cache, keep)
        self.shares += old.float().mean(1).tolist()
        return chunk

    def _stale(self, call: Call, hidden: Tensor) -> Tensor:
        """bool[B, C * T]: image tokens that are taken from memory."""
        batch, tokens, _ = hidden.shape
        nothing = torch.zeros(batch, tokens, dtype=torch.bool)
        if self.memory is None:
            return nothing
        what, value = self.reuse.what, self.reuse.value
        if what == "every":
            return torch.full_like(nothing, call.number % int(value) != 0)
        groups = {"full": 1, "camera": call.observation.images.shape[1], "patch": tokens}[what]
        now, before = (x.reshape(batch, groups, -1) for x in (hidden, self.memory.hidden))
        alike = F.cosine_similarity(now, before, dim=-1) >= value  # [B, groups]
        return alike.repeat_interleave(tokens // groups, dim=1)

    def _reused(self, embedded: EmbeddedPrefix, old: Tensor) -> KVCache:
        assert self.memory is not None
        memory = self.memory
        if self.roll:
            count = len(memory.hidden)
            memory = memory.rows([(row - self.roll) % count for row in range(count)])
        text = embedded.embs.shape[1] - old.shape[1]
        if self.reuse.what == "camera":
            stale = F.pad(old, (0, text))
            mixed = torch.where(stale[..., None], memory.embs, embedded.embs)
            return self.model.keys_values(EmbeddedPrefix(mixed, embedded.layout, embedded.lengths, embedded.state))
        # the text's keys and values are old, too, where those of all pictures are: nothing is computed then
        stale = torch.cat((old, old.all(1, keepdim=True).expand(-1, text)), dim=1)
        k, v = keys_values(self.model, embedded, stale, memory)
        return KVCache(k, v, embedded.layout.mask, embedded.lengths, embedded.state)

    def _compare(self, call: Call, embedded: EmbeddedPrefix, chunk: Tensor, old: Tensor) -> None:
        fresh = self.model.denoise(self.model.keys_values(embedded), call.noise, STEPS)
        rows = old.any(1)
        difference, size = (x[rows][..., :2].double().square().sum() for x in (chunk - fresh, fresh))
        self.errors.append((float(difference), float(size)))

    def _remember(self, hidden: Tensor, embedded: EmbeddedPrefix, cache: KVCache, keep: Tensor) -> None:
        """What was reused stays as it was computed, so that pictures can't drift away unnoticed."""
        if self.memory is None:
            self.memory = Memory(hidden, embedded.embs, cache.k, cache.v)
            return
        text = embedded.embs.shape[1] - keep.shape[1]
        stale = F.pad(keep, (0, text))[..., None]
        self.memory = Memory(
            torch.where(keep[..., None], self.memory.hidden, hidden),
            torch.where(stale, self.memory.embs, embedded.embs),
            cache.k,
            cache.v,
        )

    @property
    def error(self) -> float:
        difference, size = np.sum(self.errors, axis=0) if self.errors else (0.0, 1.0)
        return float(np.sqrt(difference / size))


def embed(model: Pi0Model, observation: Observation) -> tuple[EmbeddedPrefix, Tensor]:
    """An observation as it enters the language model, and the vision tower's tokens [B, C * T, W]."""
    trace: dict[str, Tensor] = {}
    embedded = model.embed(observation, trace=trace)
    return embedded, trace["vision_last_hidden"].transpose(0, 1).flatten(1, 2)


@torch.no_grad()
@exact_float32()
def keys_values(model: Pi0Model, embedded: EmbeddedPrefix, stale: Tensor, memory: Memory) -> tuple[Tensor, Tensor]:
    """Keys and values as `Pi0Model.keys_values`, with those of stale tokens, bool[B, S], from memory in every layer."""
    layout = embedded.layout
    assert layout.mask is None, "all tokens of these prompts are valid"
    rope = rope_tables(layout.computed_positions, model.config.vlm.head_dim, model.config.rope_base)
    chosen = stale[:, None, :, None]
    keys, values, x = [], [], embedded.embs
    for i, layer in enumerate(model.vlm.layers):
        normed, gate = layer.input_layernorm(x)
        k, v = layer.keys_values(normed, rope)
        keys.append(torch.where(chosen, memory.k[i], k))
        values.append(torch.where(chosen, memory.v[i], v))
        if i + 1 < len(model.vlm.layers):
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, keys[-1], values[-1], None), gate))
    return torch.stack(keys), torch.stack(values)


# --- what it would save -----------------------------------------------------------------------------------------------


def saved(reuse: Reuse, reused: float, whole: float, *, free: bool = False) -> dict[str, float]:
    """Shares of two stages' work that aren't done, for shares of tokens and of whole calls that are reused.

    The tower runs for every picture, to compare it; `free`: it needn't, as if that were known without it.
    """
    prefix = reused if reuse.what == "patch" else whole
    if reuse.what == "every":
        return {"vision": whole, "prefix": prefix}
    vision = reused if reuse.what == "camera" else whole  # a picture of which one patch has changed is embedded
    return {"vision": vision if free else 0.0, "prefix": prefix}


def speed_ups(reuse: Reuse, reused: float, whole: float) -> tuple[float, float, float]:
    """Of Pi0.5 for LIBERO in full size, by arithmetic: by its operations, by the H200's times of its stages, and by
    those if comparing pictures were free.
    """
    work = {name: float(stage.flops) for name, stage in stage_work(preset("pi05_libero").model, Job(), 2).items()}

    def of(cost: Mapping[str, float], total: float, free: bool = False) -> float:
        shares = saved(reuse, reused, whole, free=free)
        return total / (total - sum(cost[name] * share for name, share in shares.items()))

    ms = CALL_MS["total"]
    return of(work, sum(work.values())), of(CALL_MS, ms), of(CALL_MS, ms, free=True)


# --- the study --------------------------------------------------------------------------------------------------------


def judge(tell: Tell, name: str, folder: Path, *, count: int, small: bool) -> tuple[Played, list[ReuseCell]]:
    """A policy without reuse, and in every cell."""
    policy, episodes = open_policy(name, folder), range(count)
    baseline = play(policy, episodes, sampled(policy.model, STEPS))
    found = []
    for reuse in cells(small):
        actor = Reusing(policy.model, reuse)
        found.append(_cell(policy, reuse, play(policy, episodes, actor), baseline, actor))
        tell(f"{name}: {reuse}: {found[-1].rate.rate}, reused {found[-1].reused:.2f}")
    return baseline, found


def run(setup: Setup) -> Report:
    every = setup.each(partial(judge, count=setup.cell_episodes, small=setup.small), setup.toy_policies)
    baselines = {name: played for name, (played, _) in zip(setup.toy_policies, every, strict=True)}
    found = [cell for _, own in every for cell in own]
    return setup.report(
        STUDY,
        method=METHOD,
        controls=_controls(open_policy("chase"), range(setup.cell_episodes), baselines["chase"]),
        tables=[_table(name, played, found) for name, played in baselines.items()],
        plots=[_plot(found)],
        verdict=verdict(found),
        would_change=(
            "A task whose pictures stand still for long while the policy needs no answer; a policy that reads the "
            "state, so that old pictures may contradict it; larger pictures of which most patches never change."
        ),
        not_run=[
            "Vision alone with fresh state: none of these policies reads the state, so it equals full reuse.",
            "Measured calls: no backend reuses keys and values, so speed-ups are arithmetic.",
            "LIBERO.",
        ],
        data={"cells": [plain_document(one) for one in found], "call_ms": CALL_MS},
    )


def _cell(policy: ToyPolicy, reuse: Reuse, played: Played, baseline: Played, actor: Reusing) -> ReuseCell:
    return ReuseCell(
        policy.name,
        reuse.what,
        reuse.value,
        played.rate.document,
        played.against(baseline).document,
        float(np.mean(actor.shares)),
        float(np.mean([share == 1 for share in actor.shares])),
        actor.error,
    )


METHOD = (
    f"The float32 reference, {STEPS} steps, toy tasks in closed loop: five actions of a chunk carried out, no delay, "
    "the same episodes and noise in every cell. Image tokens are reused while their cosine to those that were last "
    "computed is at least θ: all together, camera by camera, or token by token. Speed-ups are arithmetic for "
    "pi05_libero (two cameras, 48 tokens, ten steps): by operations, by the measured times of the stages of `fused` on "
    "an H200, and by those if the vision tower needn't run to compare pictures."
)
CLAIMED = (
    "θ = 0.985 is safe and gives 1.14 ×; beyond it success falls from 100 % to 36–57 %; vision and state must be "
    "reused together."
)


def _controls(policy: ToyPolicy, episodes: Sequence[int], baseline: Played) -> list[Control]:
    few = range(min(16, len(episodes)))
    expected = play(policy, few, sampled(policy.model, STEPS)).paths
    never = [Reuse("every", 1), *(Reuse(what, NOTHING) for what in ("full", "camera", "patch"))]
    equal = all(np.array_equal(play(policy, few, Reusing(policy.model, one)).paths, expected) for one in never)
    own, others = (play(policy, episodes, Reusing(policy.model, Reuse("every", 2), roll)) for roll in (0, 1))
    rates = f"{others.rate} with another's, {own.rate} with the episode's own, {baseline.rate} plain."
    return [
        Control("With θ above any cosine the run is the plain one, bit for bit, in every form.", equal, ""),
        Control(
            "In every second call another episode's keys and values cost ten points more than the episode's own.",
            (others.against(own).difference or 0.0) < -0.1,
            rates,
        ),
    ]


def verdict(found: Sequence[ReuseCell]) -> str:
    """The largest speed-up whose success is no worse by five points, with 95 % confidence, of each policy."""
    said = []
    for policy in dict.fromkeys(cell.policy for cell in found):
        good = [c for c in found if c.policy == policy and c.against_plain.difference95[0] > -0.05]
        worse = [c for c in found if c.policy == policy and c.against_plain.difference95[1] < 0]
        best = max(good, key=lambda c: _speed(c)[1], default=None)
        count = sum(cell.policy == policy for cell in found)
        text = f"{policy}: {len(worse)} of {count} cells are worse than no reuse"
        if best is not None:
            which = Reuse(best.reuse, best.value)
            told = f"{best.rate.rate or 0:.1%}, {_speed(best)[1]:.2f} × by the stages' times"
            text += f"; the fastest that is no worse is {which} ({told})"
        said.append(text)
    return f"{'. '.join(said)}. No worse: by less than 5 points, with 95 % confidence."


def _speed(cell: ReuseCell) -> tuple[float, float, float]:
    return speed_ups(Reuse(cell.reuse, cell.value), cell.reused, cell.reused_calls)


def _table(policy: str, baseline: Played, found: Sequence[ReuseCell]) -> Grid:
    columns = ["reuse", "tokens reused, %", "calls that reuse all, %", "action error", "solved", "success, % [95 %]"]
    columns += ["against plain, points", "speed-up by operations", "by stages' times", "comparing free"]
    rows: list[list[Cell]] = [["none", 0.0, 0.0, 0.0, *rate_cells(baseline.rate.document), None, 1.0, 1.0, 1.0]]
    for cell in found:
        if cell.policy == policy:
            shares: list[Cell] = [100 * cell.reused, 100 * cell.reused_calls, cell.action_error]
            rates = [*rate_cells(cell.rate), paired_cell(cell.against_plain)]
            rows.append([str(Reuse(cell.reuse, cell.value)), *shares, *rates, *_speed(cell)])
    return Grid(f"Closed loop: {policy}", columns, rows)


def _plot(found: Sequence[ReuseCell]) -> Plot:
    panels = []
    for policy in dict.fromkeys(cell.policy for cell in found):
        kinds: Mapping[str, list[ReuseCell]] = {
            what: sorted((c for c in found if (c.policy, c.reuse) == (policy, what)), key=lambda c: c.reused)
            for what in ("full", "camera", "patch", "every")
        }
        series = [
            Series(
                what,
                [100 * c.reused for c in own],
                [100 * (c.rate.rate or 0.0) for c in own],
                [100 * c.rate.wilson95[0] for c in own],
                [100 * c.rate.wilson95[1] for c in own],
            )
            for what, own in kinds.items()
        ]
        panels.append(Panel(f"{policy}: success", "image tokens reused, %", "%, with Wilson's interval, 95 %", series))
    return Plot("kv_reuse", panels)


STUDY = Study("kv_reuse", "Can the prefix's keys and values be reused while pictures look alike?", CLAIMED, run)
