"""Recorded calls on disk, and observations written by hand: what `turbopi serve --record` writes and others read.

for observation, actions in iter_recording("DIR"): …       all runs, in order; or one run's folder, or one file
observation = load_observation("DIR/…/000000.npz")          also of other .npz files and folders: see there
"""

from turbopi.recordings.format import (
    RecordedCall,
    iter_recording,
    load_call,
    load_observation,
    recorded_files,
    save_call,
)
from turbopi.recordings.recorder import Recorder

__all__ = [
    "RecordedCall",
    "Recorder",
    "iter_recording",
    "load_call",
    "load_observation",
    "recorded_files",
    "save_call",
]
