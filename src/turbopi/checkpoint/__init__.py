"""Checkpoints of openpi (PyTorch and JAX) and LeRobot, ONNX exports and random weights, behind one interface.

    checkpoint = open_checkpoint("path/to/checkpoint", config="pi05_libero")
    state = checkpoint.load("cuda", "bf16").state  # canonical names, see models/pi0/reference.py

Every tensor must have its place and every place its tensor: nothing is skipped in silence, and nothing made up.
"""

from turbopi.checkpoint.base import Checkpoint, Loaded
from turbopi.checkpoint.convert import convert, write_beside, write_random
from turbopi.checkpoint.norm_stats import FeatureStats, NormStats, load_norm_stats
from turbopi.checkpoint.opening import inspect_checkpoint, open_checkpoint
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.checkpoint.settings import ConfigSource

__all__ = [
    "Checkpoint",
    "ConfigSource",
    "FeatureStats",
    "Loaded",
    "NormStats",
    "convert",
    "inspect_checkpoint",
    "load_norm_stats",
    "open_checkpoint",
    "random_checkpoint",
    "write_beside",
    "write_random",
]
