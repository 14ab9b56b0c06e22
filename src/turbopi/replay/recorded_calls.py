"""What `turbopi serve --record` wrote, as a dataset: a run is an episode, a call a moment, its answer was recorded."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from turbopi.recordings import load_call, recorded_files
from turbopi.replay.episodes import Dataset, Episode, Moment, checked_actions
from turbopi.support.errors import ObservationError
from turbopi.support.reading import listing


class RecordedCalls(Dataset):
    """Calls that a server answered, each with a chunk of its own. Their observations have the robot's own keys."""

    kind = "recording of turbopi serve"
    caveat = (
        "the recorded actions are the answers of the policy that was served then, not what a person did: small errors "
        "say that it is the same policy in the same set-up, not that it is right"
    )

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._runs: dict[Path, list[Path]] = {}
        for file in recorded_files(path):
            self._runs.setdefault(file.parent, []).append(file)

    @cached_property
    def episodes(self) -> Sequence[Episode]:
        return tuple(Episode(n, len(files), run.name) for n, (run, files) in enumerate(self._runs.items()))

    def moments(self, episode: Episode, steps: Sequence[int], horizon: int) -> Iterator[Moment]:
        files = list(self._runs.values())[episode.number]
        for step in steps:
            call = load_call(files[step])
            if "actions" not in call.result:
                raise ObservationError(
                    f"{files[step]} holds no actions, only {listing(list(call.result)) or 'nothing'}"
                )
            chunk = checked_actions(np.asarray(call.result["actions"]), None, str(files[step]))
            yield Moment(episode, step, call.observation, chunk[:horizon], None)
