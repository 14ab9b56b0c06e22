"""Certificates for tables, and the checked-in results of studies: each reads and comes out as it was."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import turbopi
from msgspec import Struct

from turbopi import UnifiedPolicy
from turbopi.checkpoint import random_checkpoint
from turbopi.support.errors import ConfigError
from turbopi.support.reading import as_document, plain_document, read_document
from turbopi.verify.document import Certificate, Determinism
from turbopi_lab.studies import certificates
from turbopi_lab.studies.actions import BackendOff
from turbopi_lab.studies.certificates import CondensedDimension, WorstPlace
from turbopi_lab.studies.fp8_and_fp4 import Research
from turbopi_lab.studies.mask import CacheOff
from turbopi_lab.studies.throughput import Throughput

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("two_layers")]

RESULTS = Path(__file__).parents[3] / "benchmarks" / "results"


def test_a_certificate_is_condensed_to_the_worst_of_every_name() -> None:
    result = turbopi(
        *("verify", "--random-weights", "pi05_tiny", "--device", "cpu", "--steps", 2, "--count", 1, "--noises", 2),
        *("--backend", "pytorch", "--precision", "bf16", "--json"),
    )
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    condensed: Any = plain_document(certificates.condensed(as_document(document, Certificate, "stdout")))
    rows = [row for row in document["intermediates"] if row["name"] == "kv_k"]
    worst = max(rows, key=lambda row: row["relative_rms"])
    assert condensed["intermediates"]["kv_k"]["at"] == worst["index"]
    assert condensed["intermediates"]["kv_k"]["relative_rms"] == pytest.approx(worst["relative_rms"], rel=1e-3)
    assert condensed["verdict"] == document["verdict"]
    assert len(json.dumps(condensed, allow_nan=False)) < len(json.dumps(document)) / 2


def test_varied_observations_are_no_two_alike_and_come_again() -> None:
    first, again, other = (list(certificates.varied(seed, 8)) for seed in (0, 0, 1))
    camera_images = [np.asarray(one["observation/image"]).tobytes() for one in (*first, *other)]
    assert len(set(camera_images)) == 16
    assert [np.asarray(one["observation/image"]).tobytes() for one in again] == camera_images[:8]
    policy = UnifiedPolicy(random_checkpoint("pi05_tiny"), backend="pytorch", device="cpu")
    assert policy.prepare(first[7]).token_mask.any()


@pytest.mark.parametrize("name", [path.name for path in sorted(RESULTS.glob("*fp8_research.json"))])
def test_checked_in_research_reads_and_comes_out_as_it_was(name: str) -> None:
    document = read_document(RESULTS / name, Research, ConfigError)
    assert json.dumps(plain_document(document)) == json.dumps(json.loads((RESULTS / name).read_text()))


def test_the_tables_of_checked_in_certificates_read_and_come_out_as_they_were() -> None:
    """The certificates as a whole were shortened by hand."""
    kinds: dict[str, type[Struct]] = {"dimensions": CondensedDimension, "intermediates": WorstPlace}
    content = json.loads((RESULTS / "h200_2026-11-22_fp8_certificates.json").read_text())
    read = 0
    for tiers in content["certificates"].values():
        for tier in (tiers["fp8"], tiers["fp8-mlp"]):
            assert plain_document(as_document(tier["determinism"], Determinism, "FILE")) == tier["determinism"]
            for key, kind in kinds.items():
                for row in tier.get(key, {}).values():
                    assert plain_document(as_document(row, kind, "FILE")) == row
                    read += 1
    assert read > 30


def test_the_parts_of_the_checked_in_study_read_and_come_out_as_they_were() -> None:
    """Two runs were put into one file by hand, and the precision study lost its cosines."""
    content = json.loads((RESULTS / "h200_2026-11-21_tensorrt_study.json").read_text())
    rows: list[tuple[type[Struct], dict[str, object]]] = [(Throughput, content["throughput"])]
    rows += [(CacheOff, row) for row in content["mask"]] + [(BackendOff, row) for row in content["actions"]]
    for kind, row in rows:
        assert json.dumps(plain_document(as_document(row, kind, "FILE"))) == json.dumps(row)
