"""From what policies did to the document and the report folder."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
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
from turbopi.replay.run import Replay, Replayed, Settings
from turbopi.support.action_groups import names_of as names_in
from turbopi.support.errors import ConfigError
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
        self._rows = worst_moments(self._compared[0], WORST)
        self._observations = [replay.observation_at(*run.moments[row]) for row in self._rows]
        self._prompt_key = run.keys.prompt
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
        self._compared = [compared(label, first.run), compared(second.label, run, first.run.units)]
        self._checkpoints.append(second.checkpoint)

    def write(self, folder: Path) -> ReplayDocument:
        """Write the report; returns its document. CAMERAS are written if nothing shows a mistake, else removed."""
        document = self.document()
        material = Material(self._compared, self._rows, self._observations, self._dataset.action_names)
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
        prompts = [self._prompt(observation) for observation in self._observations]
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
            [self._worst(row, prompt) for row, prompt in zip(self._rows, prompts, strict=True)],
            judge(first, policies[0], beside, states, prompts[0]),
            list(self._notes(first, policies[0], beside)),
            provenance(self._device),
        )

    def _state_names(self) -> tuple[str, ...] | None:
        about, keys = self._compared[0].run.about, self._compared[0].run.keys
        numbers = [source for key, source in keys.joined.items() if key not in keys.cameras]
        of_data = self._dataset.names_of(numbers[0]) if len(numbers) == 1 else None
        return tuple(names_in(about, "state") or ()) if of_data is None else of_data

    def _prompt(self, observation: Mapping[str, Any]) -> str:
        about = self._compared[0].run.about
        return str(observation.get(self._prompt_key, about["default_prompt"]))

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
