"""Shapes of an exported graph's inputs once its free axes are chosen."""

from turbopi.checkpoint.onnx_folder import Export
from turbopi.support.errors import ConfigError


def shapes_of(export: Export, graph: str, **lengths: int) -> dict[str, tuple[int, ...]]:
    """Input -> shape, with lengths for the free axes by name: images, prompt, prefix, horizon.

    Raises ConfigError for an axis without a length.
    """
    found = {}
    for name, one in export.manifest["graphs"][graph]["inputs"].items():
        axes = []
        for axis in one["shape"]:
            base, _, more = str(axis).partition(" + ")  # Pi0's positions are "horizon + 1" long
            if not isinstance(axis, int) and base not in lengths:
                raise ConfigError(f"{graph}: the axis {base!r} of {name} has no length; given are {sorted(lengths)}")
            axes.append(axis if isinstance(axis, int) else lengths[base] + int(more or 0))
        found[name] = tuple(axes)
    return found
