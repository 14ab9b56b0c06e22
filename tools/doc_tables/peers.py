"""README's plot of our latency beside others': ours from a result file, theirs from benchmarks/peers.json."""

import hashlib
import json
from pathlib import Path
from typing import Annotated

from matplotlib.figure import Figure
from msgspec import Meta, Struct
from PIL import Image

from turbopi.bench.document import BenchDocument, read_benchmark
from turbopi.bench.plots import DRAWN_OF, fingerprint
from turbopi.errors import ConfigError
from turbopi.plots import MEASURED, MUTED, write_figure
from turbopi.reading import plain_document, read_document

PEERS, PLOT = Path("benchmarks") / "peers.json", Path("docs") / "latency.png"
TEXT = "#7d8590"  # legible on white and on black: the background is the page's
OURS = (("fused", "fp8", "Turbo-Pi, FP8"), ("fused", "bf16", "Turbo-Pi, bf16"))


class Peer(Struct, frozen=True):
    name: str
    ms: Annotated[float, Meta(gt=0)]
    how: str  # it was run


class Peers(Struct, frozen=True):
    """Others' figures, measured by this project without keeping a result file."""

    about: str
    measured: str  # when, and on what
    ours: str  # the result file of ours, below benchmarks/results
    peers: list[Peer]


def read_peers(root: Path) -> Peers:
    return read_document(root / PEERS, Peers, ConfigError)


def bars(root: Path) -> list[tuple[str, float, bool]]:
    """(name, milliseconds, whether it's ours), the fastest first."""
    peers = read_peers(root)
    document = _ours(root, peers)
    ours = [(name, _median(document, backend, precision), True) for backend, precision, name in OURS]
    return sorted([*ours, *((peer.name, peer.ms, False) for peer in peers.peers)], key=lambda bar: bar[1])


def draw_peers(root: Path) -> list[Path]:
    """Draw the plot if it wasn't drawn of these figures; returns what was written."""
    if not stale_peers(root):
        return []
    drawn = bars(root)
    figure = Figure(figsize=(7.6, 0.36 * len(drawn) + 0.75), layout="constrained")
    figure.patch.set_alpha(0)
    ax = figure.add_subplot()
    ax.patch.set_alpha(0)
    colors = [MEASURED if ours else MUTED for _, _, ours in drawn]
    found = ax.barh([name for name, _, _ in drawn], [ms for _, ms, _ in drawn], color=colors, height=0.68)
    ax.bar_label(found, [f"{ms:.1f} ms" for _, ms, _ in drawn], padding=4, color=TEXT, fontsize=10.5, weight="bold")
    ax.invert_yaxis()
    ax.margins(x=0.13, y=0.02)
    ax.set_xlabel("milliseconds a call, H = 10: less is better", color=TEXT, fontsize=10)
    ax.tick_params(colors=TEXT, labelsize=10.5, length=0)
    for label, (_, _, ours) in zip(ax.get_yticklabels(), drawn, strict=True):
        label.set_fontweight("bold" if ours else "normal")
    for side in ax.spines.values():
        side.set_visible(False)
    write_figure(root / PLOT, figure, 150, about={DRAWN_OF: _fingerprint(root)})
    return [root / PLOT]


def stale_peers(root: Path) -> list[str]:
    """One line if the plot is missing, or was drawn of other figures."""
    if not (root / PEERS).is_file():
        return []
    if not (root / PLOT).is_file():
        return [f"{PLOT.as_posix()}: there is no such plot; run scripts/tables"]
    with Image.open(root / PLOT) as picture:
        drawn_of = picture.info.get(DRAWN_OF)
    if drawn_of != _fingerprint(root):
        return [f"{PLOT.as_posix()}: drawn of other figures than {PEERS.as_posix()} and its result file have"]
    return []


def _ours(root: Path, peers: Peers) -> BenchDocument:
    return read_benchmark(root / "benchmarks" / "results" / peers.ours)


def _median(document: BenchDocument, backend: str, precision: str) -> float:
    (result,) = (one for one in document.main_results if (one.backend, one.precision) == (backend, precision))
    return result.milliseconds["total"].p50


def _fingerprint(root: Path) -> str:
    peers = read_peers(root)
    both = json.dumps([plain_document(peers), fingerprint(_ours(root, peers))], sort_keys=True)
    return hashlib.sha256(both.encode()).hexdigest()
