"""From what policies did to the document and the report folder."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from turbopi.checkpoint import Checkpoint
from turbopi.policy.known_cameras import KnownCameras
from turbopi.replay.compare import (
    HELD,
    NEVER_MOVED,
    Compared,
    against,
    compared,
    controls,
    names_of,
    policy_document,
    state_documents,
    worst_moments,
)
from turbopi.replay.document import Control, DatasetDocument, PolicyDocument, ReplayDocument, Worst
from turbopi.replay.episodes import Dataset, Selection
from turbopi.replay.judge import judge
from turbopi.replay.page import Material, write_report
from turbopi.replay.run import Replay, Replayed, Settings, broken_text
from turbopi.support.action_groups import names_of as names_in
from turbopi.support.errors import ActionError, ConfigError
from turbopi.support.provenance import provenance
from turbopi.support.text import significant

CAMERAS = "cameras.npz"  # what each camera shows, for `turbopi serve --known-cameras`

WORST = 4  # moments that are shown


@dataclass(frozen=True)
class Second:
    """What --against names: how it is run, its weights, and what it is called. `options`: the command line's."""

    options: Any
    checkpoint: Checkpoint
    label: str


def name_of(checkpoint: Checkpoint) -> str:
    """Its folder's name."""
    return "random weights" if checkpoint.path is None else checkpoint.path.resolve().name


def _way(run: Replayed) -> str:
    return f"{run.about['backend']} {run.about['precision']}"


class Report:
    """Made after the first policy has run, as long as it is there; a second one may be added."""

    def __init__(
        self,
        dataset: Dataset,
        selection: Selection,
        settings: Settings,
        replay: Replay,
        run: Replayed,
        checkpoint: Checkpoint,
    ) -> None:
        self._dataset, self._selection, self._settings = dataset, selection, settings
        self._checkpoints = [checkpoint]
        self._device = torch.device(str(run.about["device"]))
        self._compared = [compared(f"{name_of(checkpoint)}, {_way(run)}", run)]
        self._key_notes = replay.notes

    def add(self, second: Second, run: Replayed) -> None:
        """Raises ConfigError for a robot with other actions."""
        first = self._compared[0]
        if run.predicted.shape[2] != first.run.predicted.shape[2]:
            raise ConfigError(
                f"--against {second.label} has {run.predicted.shape[2]} actions a step, the first policy "
                f"{first.run.predicted.shape[2]}: there is nothing to compare"
            )
        own = self._checkpoints[0]
        label = _way(first.run) if second.checkpoint is own else name_of(own)
        if label == second.label:
            label = str(own.path)
        both = [moment for moment in first.run.moments if moment in run.moments]
        if not both:
            raise ActionError(f"--against {second.label} answered at none of the moments that the first policy did")
        own_run, other = (one.only([one.moments.index(moment) for moment in both]) for one in (first.run, run))
        self._compared = [compared(label, own_run), compared(second.label, other, own_run.units)]
        self._checkpoints.append(second.checkpoint)

    def write(self, folder: Path) -> ReplayDocument:
        """Write the report; returns its document. CAMERAS are written if nothing shows a mistake, else removed."""
        document = self.document()
        rows = [row for row, _ in self._worst_moments]
        observations = [observation for _, observation in self._worst_moments]
        material = Material(self._compared, rows, observations, self._dataset.action_names)
        write_report(folder, document, material)
        known = KnownCameras.of_samples(self._compared[0].run.cameras) if document.verdict.passed else None
        if known is None:
            (folder / CAMERAS).unlink(missing_ok=True)
        else:
            known.save(folder / CAMERAS)
        return document

    def document(self) -> ReplayDocument:
        """What was found."""
        first, dataset, selection = self._compared[0], self._dataset, self._selection
        policies = [
            policy_document(one, str(checkpoint.path or "random weights"), dataset.action_names)
            for one, checkpoint in zip(self._compared, self._checkpoints, strict=True)
        ]
        beside = controls(first)
        states = state_documents(first.run, self._state_names())
        worst = [self._worst(row, self._prompt(observation)) for row, observation in self._worst_moments]
        return ReplayDocument(
            DatasetDocument(
                str(dataset.path),
                dataset.kind,
                dataset.fps,
                selection.of_episodes,
                selection.of_moments,
                [episode.number for episode in selection.episodes],
                selection.every,
                selection.count,
            ),
            self._settings.seed,
            policies,
            against(*self._compared) if len(self._compared) > 1 else None,
            beside,
            states,
            worst,
            judge(first, policies[0], beside, states, worst[0].prompt),
            list(self._notes(first, policies[0], beside)),
            provenance(self._device),
        )

    def _state_names(self) -> tuple[str, ...] | None:
        about, keys = self._compared[0].run.about, self._compared[0].run.keys
        numbers = [source for key, source in keys.joined.items() if key not in keys.cameras]
        of_data = self._dataset.names_of(numbers[0]) if len(numbers) == 1 else None
        return tuple(names_in(about, "state") or ()) if of_data is None else of_data

    @cached_property
    def _worst_moments(self) -> list[tuple[int, dict[str, Any]]]:
        """Of the first policy: the row, and the observation."""
        first, keys = self._compared[0], self._compared[0].run.keys
        self._dataset.wanted = frozenset(keys.joined.values())  # a second policy may have read others
        found = []
        for row in worst_moments(first, WORST):
            episode, step = first.run.moments[row]
            (moment,) = self._dataset.moments(episode, [step], 1)
            found.append((row, keys.observation(moment.observation, self._settings.task)))
        return found

    def _prompt(self, observation: Mapping[str, Any]) -> str:
        run = self._compared[0].run
        return str(observation.get(run.keys.prompt, run.about["default_prompt"]))

    def _worst(self, row: int, prompt: str) -> Worst:
        first = self._compared[0]
        episode, step = first.run.moments[row]
        return Worst(episode.name, step, float(first.by_moment[row]), prompt)

    def _notes(self, first: Compared, policy: PolicyDocument, beside: list[Control]) -> Iterator[str]:
        dataset = self._dataset
        yield from dataset.notes
        yield from self._key_notes
        if dataset.caveat is not None:
            yield dataset.caveat
        for other in self._compared[1:]:
            if broken := other.run.broken:
                yield f"{len(broken)} answers of {other.label} are no chunk; the first: {broken_text(broken[0])}"
        still = [
            name
            for (name, _), unit in zip(names_of(first, dataset.action_names), first.run.units, strict=True)
            if unit <= NEVER_MOVED
        ]
        if still:
            yield f"never moved in the checkpoint's training, so without a relative error: {', '.join(still)}"
        held = next((control for control in beside if control.name == HELD), None)
        if held is not None and held.relative < policy.relative.mean:
            yield (
                f"{HELD}, is nearer ({significant(held.relative)}) than the policy "
                f"({significant(policy.relative.mean)}): over one chunk little moves here, so small errors alone say "
                "little; compare with the other controls"
            )
