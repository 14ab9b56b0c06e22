"""Reuse of the prefix's keys and values while images look alike: how much work does it save, at what price?

The similarity is the cosine of the vision tower's tokens now and when they were last computed, so the tower runs in
every call; only `every k-th call` saves it, too. What is reused, where the similarity is at least θ:

    full         all keys and values, of images and text
    per camera   a camera's tokens as they enter the language model, which runs over old and new ones
    per patch    keys and values of single image tokens, in all layers, as VLA-Cache does (Xu et al. 2025); text and
                 changed tokens are computed, and attend to old ones
    every k      all keys and values in k − 1 of k calls, whatever the images show

Vision alone, with text and state computed afresh, gives what `full` gives where neither text nor state changes: the
policies here have one instruction and read no state.
"""

from collections.abc import Hashable, Mapping, Sequence
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
from turbopi.models.observation import Observation
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.kv_cache import EmbeddedPrefix, KVCache
from turbopi.models.pi0.layers import gated_residual, rope_tables
from turbopi.models.pi0.prefix import camera_slots
from turbopi.models.pi0.reference import Pi0Model
from turbopi.support.reading import plain_document
from turbopi_lab.studies.report import (
    MARGIN,
    PERCENT,
    Cell,
    Control,
    Grid,
    Panel,
    Plot,
    Report,
    compared,
    paired_cell,
    rate_cells,
    rate_series,
)
from turbopi_lab.studies.rollouts import Call, Played, ToyPolicy, open_policy, play, sampled
from turbopi_lab.studies.study import Setup, Study, Tell

NOTHING = 1.5  # θ above any cosine: nothing is ever reused
STEPS = 5
MOST_REMEMBERED = 128  # episodes: more than run at a time; one takes some 50 MB of a model of full size
# Milliseconds of stages and of the whole call: `fused` bf16, pi05_libero, two cameras, 48 tokens, ten steps, H200
# (2026-11-24; the reports' speed-ups are by these)
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

    @property
    def verdict(self) -> str:
        return compared(self.against_plain)


@dataclass
class Memory:
    """What earlier calls left: tokens to compare with, embeddings, keys and values, in the padded prefix's slots.

    Of one episode. Of several, as a batch: k and v [layer, B, G, S, K], in the slots that are computed.
    """

    hidden: Tensor  # [C * T, W]
    embs: Tensor  # [S, D]
    k: Tensor  # [layer, G, S, K]
    v: Tensor


@dataclass
class Reusing:
    """Answers calls with what `reuse` allows, and counts. `roll`: each episode has the memory of one so far away.

    compare  also compute what fresh keys and values would give, for `error`
    """

    model: Pi0Model
    reuse: Reuse
    roll: int = 0
    compare: bool = True
    memory: dict[Hashable, Memory] = field(default_factory=dict)  # by episode, in the order of their last calls
    shares: list[float] = field(default_factory=list)  # of each episode's call: image tokens that are reused
    errors: list[tuple[float, float]] = field(default_factory=list)

    def __call__(self, call: Call) -> Tensor:
        """Of toy tasks: all episodes are at the same call, and those that are decided come no more."""
        self.memory = {episode: self.memory[episode] for episode in call.episodes if episode in self.memory}
        numbers = [call.number] * len(call.episodes)
        return self.answer(call.observation, call.noise, STEPS, call.episodes, numbers)

    def answer(
        self, observation: Observation, noise: Tensor, steps: int, episodes: Sequence[Hashable], numbers: Sequence[int]
    ) -> Tensor:
        """Chunks float32[B, H, A]. episodes: of the rows; numbers: of each one's call, 0 forgets what was before."""
        for episode, number in zip(episodes, numbers, strict=True):
            if number == 0:
                self.memory.pop(episode, None)
        embedded, hidden = embed(self.model, observation)
        before = self._recalled(episodes, embedded, hidden)
        old = self._stale(numbers, hidden, before, [episode in self.memory for episode in episodes])
        if bool(old.any()):
            cache = self._reused(embedded, old, self._recalled(self._rolled(episodes), embedded, hidden))
        else:
            cache = self.model.keys_values(embedded)
        chunk = self.model.denoise(cache, noise, steps)
        if self.compare and bool(old.any()):
            fresh = self.model.denoise(self.model.keys_values(embedded), noise, steps)
            rows = old.any(1)
            difference, size = (x[rows][..., :2].double().square().sum() for x in (chunk - fresh, fresh))
            self.errors.append((float(difference), float(size)))
        self._remember(episodes, hidden, embedded, cache, old, before)
        self.shares += old.float().mean(1).tolist()
        return chunk

    def _rolled(self, episodes: Sequence[Hashable]) -> list[Hashable]:
        order = list(self.memory)
        place = {episode: number for number, episode in enumerate(order)}
        return [order[(place[one] - self.roll) % len(order)] if one in place else one for one in episodes]

    def _recalled(self, episodes: Sequence[Hashable], embedded: EmbeddedPrefix, hidden: Tensor) -> Memory:
        """The episodes' memories in the slots that are computed now; of those that have none, zeros."""
        layout, found = embedded.layout, [self.memory.get(episode) for episode in episodes]
        known = next((one for one in found if one is not None), None)
        if known is None:
            nothing = hidden.new_zeros(0)
            return Memory(torch.zeros_like(hidden), torch.zeros_like(embedded.embs), nothing, nothing)

        def rows(name: str, dim: int | None) -> Tensor:
            empty = torch.zeros_like(getattr(known, name))
            stacked = torch.stack([empty if one is None else getattr(one, name) for one in found])
            return stacked if dim is None or layout.columns is None else stacked.index_select(dim, layout.columns)

        k, v = (rows(name, 3).transpose(0, 1) for name in ("k", "v"))
        return Memory(rows("hidden", None), rows("embs", 1), k, v)

    def _stale(self, numbers: Sequence[int], hidden: Tensor, before: Memory, known: Sequence[bool]) -> Tensor:
        """bool[B, C * T]: image tokens that are taken from memory."""
        batch, tokens, _ = hidden.shape
        what, value = self.reuse.what, self.reuse.value
        there = torch.tensor(known, device=hidden.device)[:, None]
        if what == "every":
            skipped = torch.tensor([number % int(value) != 0 for number in numbers], device=hidden.device)
            return (skipped[:, None] & there).expand(-1, tokens)
        groups = {"full": 1, "camera": tokens // self.model.config.vision.num_tokens, "patch": tokens}[what]
        now, then = (x.reshape(batch, groups, -1) for x in (hidden, before.hidden))
        alike = F.cosine_similarity(now, then, dim=-1) >= value  # [B, groups]
        return alike.repeat_interleave(tokens // groups, dim=1) & there

    def _reused(self, embedded: EmbeddedPrefix, old: Tensor, memory: Memory) -> KVCache:
        text = embedded.embs.shape[1] - old.shape[1]
        if self.reuse.what == "camera":
            stale = F.pad(old, (0, text))
            mixed = torch.where(stale[..., None], memory.embs, embedded.embs)
            return self.model.keys_values(EmbeddedPrefix(mixed, embedded.layout, embedded.lengths, embedded.state))
        # the text's keys and values are old, too, where those of all images are: nothing is computed then
        stale = torch.cat((old, old.all(1, keepdim=True).expand(-1, text)), dim=1)
        k, v = keys_values(self.model, embedded, stale, memory)
        return KVCache(k, v, embedded.layout.mask, embedded.lengths, embedded.state)

    def _remember(
        self,
        episodes: Sequence[Hashable],
        hidden: Tensor,
        embedded: EmbeddedPrefix,
        cache: KVCache,
        keep: Tensor,
        before: Memory,
    ) -> None:
        """What was reused stays as it was computed, so that images can't drift away unnoticed."""
        stale = F.pad(keep, (0, embedded.embs.shape[1] - keep.shape[1]))[..., None]
        padded = embedded.layout.to_padded
        hidden = torch.where(keep[..., None], before.hidden, hidden)
        embs = padded(torch.where(stale, before.embs, embedded.embs), 1)
        k, v = padded(cache.k, 3), padded(cache.v, 3)
        for row, episode in enumerate(episodes):
            self.memory.pop(episode, None)  # the last one is the latest
            rows = hidden[row], embs[row], k[:, row], v[:, row]
            self.memory[episode] = Memory(*(one.clone() for one in rows))  # not a view, which keeps the whole batch
        for episode in list(self.memory)[: -max(MOST_REMEMBERED, len(episodes))]:
            del self.memory[episode]

    @property
    def error(self) -> float:
        difference, size = np.sum(self.errors, axis=0) if self.errors else (0.0, 1.0)
        return float(np.sqrt(difference / size))


def embed(model: Pi0Model, observation: Observation) -> tuple[EmbeddedPrefix, Tensor]:
    """An observation as it enters the language model, and the vision tower's tokens [B, C * T, W] of its cameras."""
    trace: dict[str, Tensor] = {}
    embedded = model.embed(observation, trace=trace)
    hidden, cameras = trace["vision_last_hidden"].transpose(0, 1), camera_slots(observation, compact=True)
    return embedded, (hidden if cameras is None else hidden[:, cameras]).flatten(1, 2)


@torch.no_grad()
@exact_float32()
def keys_values(model: Pi0Model, embedded: EmbeddedPrefix, stale: Tensor, memory: Memory) -> tuple[Tensor, Tensor]:
    """Keys and values as `Pi0Model.keys_values`, with those of stale tokens, bool[B, S], from memory in every layer.

    memory  of several episodes, k and v [layer, B, G, S, K]
    """
    layout = embedded.layout
    mask = None if layout.mask is None else layout.mask[:, None, None, :]
    rope = rope_tables(layout.computed_positions, model.config.vlm.head_dim, model.config.rope_base)
    chosen = stale[:, None, :, None]
    keys, values, x = [], [], embedded.embs
    for i, layer in enumerate(model.vlm.layers):
        normed, gate = layer.input_layernorm(x)
        k, v = layer.keys_values(normed, rope)
        keys.append(torch.where(chosen, memory.k[i], k))
        values.append(torch.where(chosen, memory.v[i], v))
        if i + 1 < len(model.vlm.layers):
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, keys[-1], values[-1], mask), gate))
    return torch.stack(keys), torch.stack(values)


# --- what it would save -----------------------------------------------------------------------------------------------


def saved(reuse: Reuse, reused: float, whole: float, *, free: bool = False) -> dict[str, float]:
    """Shares of two stages' work that aren't done, for shares of tokens and of whole calls that are reused.

    The tower runs for every image, to compare it; `free`: it needn't, as if that were known without it.
    """
    prefix = reused if reuse.what == "patch" else whole
    if reuse.what == "every":
        return {"vision": whole, "prefix": prefix}
    vision = reused if reuse.what == "camera" else whole  # an image of which one patch has changed is embedded
    return {"vision": vision if free else 0.0, "prefix": prefix}


def speed_ups(reuse: Reuse, reused: float, whole: float) -> tuple[float, float, float]:
    """Of Pi0.5 for LIBERO in full size, by arithmetic: by its operations, by the H200's times of its stages, and by
    those if comparing images were free.
    """
    work = {
        name: float(stage.flops) for name, stage in stage_work(preset("pi05_libero").planned_model, Job(), 2).items()
    }

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
            "A task whose images stand still for long while the policy needs no answer; a policy that reads the "
            "state, so that old images may contradict it; larger images of which most patches never change."
        ),
        not_run=[
            "Vision alone with fresh state: none of these policies reads the state, so it equals full reuse.",
            "Measured calls: no backend reuses keys and values, so speed-ups are arithmetic.",
            "LIBERO: `turbopi study kv_reuse_libero`.",
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
    "an H200, and by those if the vision tower needn't run to compare images."
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
    """Of each policy how many cells are worse, and the fastest one that is as good."""
    said = []
    for policy in dict.fromkeys(cell.policy for cell in found):
        own = [cell for cell in found if cell.policy == policy]
        worse = sum(cell.verdict == "worse" for cell in own)
        text = f"{policy}: {worse} of {len(own)} cells are worse than no reuse"
        good = [cell for cell in own if cell.verdict == "as good"]
        if good:
            best = max(good, key=lambda cell: _speed(cell)[1])
            reported = f"{best.rate.rate or 0:.1%}, {_speed(best)[1]:.2f} × by the stages' times"
            text += f"; the fastest that is as good is {Reuse(best.reuse, best.value)} ({reported})"
        said.append(text)
    return f"{'. '.join(said)}. “As good”: not worse by {100 * MARGIN:.0f} points, with 95 % confidence."


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
            rate_series(what, [100 * c.reused for c in own], [c.rate for c in own]) for what, own in kinds.items()
        ]
        panels.append(Panel(f"{policy}: success", "image tokens reused, %", PERCENT, series))
    return Plot("kv_reuse", panels)


STUDY = Study("kv_reuse", "Can the prefix's keys and values be reused while images look alike?", CLAIMED, run)
