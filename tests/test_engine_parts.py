"""Large batches go in parts, images through vision's head and the prefix between two attentions: nothing changes."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import golden_model
from hypothesis import given
from hypothesis import strategies as st
from test_begin import OnCpu, on_cpu
from test_capture import DONE, FakeCuda, capture
from test_engine import send
from test_engine_batch import observations
from test_resize import Resizing, camera_image
from torch import Tensor

from turbopi.config import ImageResize
from turbopi.engine import call, forward
from turbopi.engine.batch import BatchBuffers, BatchSize, PackedPrefix
from turbopi.engine.call import Images, Part
from turbopi.engine.forward import MOST_ROWS, row_chunks
from turbopi.engine.runner import HostRow
from turbopi.engine.weights import Weights, pack
from turbopi.kernels.interface import Ops
from turbopi.kernels.plain import PLAIN
from turbopi.kernels.portable.quantize import quantize
from turbopi.preprocess.images import fitted
from turbopi.quantization.fp8 import Matrix
from turbopi.support.errors import BackendError

CAMERAS = [2, 0, 3, 1]


class TestPrefix:
    """In chunks of rows."""

    @given(st.integers(1, 5 * MOST_ROWS))
    def test_chunks_are_few_and_equal(self, rows: int) -> None:
        chunks = row_chunks(rows)
        sizes = [chunk.stop - chunk.start for chunk in chunks]
        assert [*(chunk.start for chunk in chunks), rows] == [0, *(chunk.stop for chunk in chunks)]
        assert len(chunks) == -(-rows // MOST_ROWS)
        assert len(set(sizes[:-1])) <= 1 and all(size % 64 == 0 for size in sizes[:-1])
        assert max(sizes) <= MOST_ROWS and sizes[-1] <= sizes[0]

    def test_a_single_call_and_a_batch_of_eight_are_one_chunk(self) -> None:
        assert [len(row_chunks(rows)) for rows in (560, 8 * 560)] == [1, 1]
        assert row_chunks(16 * 560) == [slice(0, 4480), slice(4480, 8960)]

    @pytest.mark.parametrize("fp8", [False, True])
    def test_keys_and_values_are_those_of_one_chunk(self, fp8: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        """In chunks of 64 rows, and what is left."""
        whole, parts = (prefix(PLAIN, fp8, monkeypatch, most) for most in (MOST_ROWS, 64))
        assert whole[0].shape[1] % 64, "not whole chunks"
        for one, other in zip(whole, parts, strict=True):
            assert bool(one.isfinite().all())
            torch.testing.assert_close(other, one, atol=2e-5, rtol=2e-5)

    def test_each_chunk_goes_from_one_attention_to_the_next_before_the_next_chunk(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        depth = golden_model("pi05").config.vlm.depth
        first, between = ["norm", "linear"], ["residual", "norm", "geglu", "residual", "norm", "linear"]
        for most in (MOST_ROWS, 64):
            ran: list[tuple[str, int]] = []
            rows = prefix(telling(ran), False, monkeypatch, most)[0].shape[1]
            sizes = [chunk.stop - chunk.start for chunk in row_chunks(rows)]
            expected: list[tuple[str, int]] = []
            for names in [first] + [between] * (depth - 1):
                expected += [*((name, size) for size in sizes for name in names), ("rope", rows)]
            assert ran == expected and (len(sizes) == 1) == (most == MOST_ROWS)

    def test_one_chunk_has_no_buffer_to_be_copied_into(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Plain products with `out` are copied there."""

        def linear(x: Tensor, weight: Matrix, bias: Tensor | None = None, out: Tensor | None = None) -> Tensor:
            assert out is None
            return PLAIN.linear(x, weight, bias)

        prefix(dataclasses.replace(PLAIN, linear=linear), False, monkeypatch, MOST_ROWS)


class TestAdded:
    """Operations that add a product to the residual stream themselves, in place."""

    @pytest.mark.slow
    @pytest.mark.parametrize("most", [MOST_ROWS, 64])
    @pytest.mark.parametrize("every", [1, 2])
    def test_a_batchs_keys_and_values_stay(self, most: int, every: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """Also where every second product is left to the norm, and when the graph runs again."""
        usual = prefix(PLAIN, False, monkeypatch, most)
        ours = prefix(adding(every), False, monkeypatch, most, runs=2)
        for one, other in zip(usual, ours, strict=True):
            assert bool(one.isfinite().all()) and torch.equal(one, other)

    @pytest.mark.parametrize("every", [1, 2, 3])
    @pytest.mark.parametrize("part", [2, 100])
    def test_pictures_tokens_stay(self, every: int, part: int, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(call, "PART", part)
        side = golden_model("pi05").config.vision.image_size
        shown = [camera_image(side, side, seed=seed) for seed in range(5)]
        for layers in (1, 3):
            monkeypatch.setattr(forward, "HEAD_LAYERS", layers)
            found = []
            for ops in (PLAIN, adding(every)):
                camera_images = Images(golden_model("pi05").config, packed(), ops, 5, False, 0)
                send(camera_images, shown)
                camera_images.run()
                found.append(camera_images.embs)
            assert bool(found[0].isfinite().all()) and torch.equal(*found)

    def test_one_observations_embeddings_are_not_written_over(self) -> None:
        """Its prefix may be run again on the images' tokens, which another graph has left."""

        def refused(*given: Any) -> bool:
            raise AssertionError("the embeddings would be written over")

        model = golden_model("pi05")
        config, weights = model.config, packed()
        x = torch.randn(40, config.vlm.width, generator=torch.Generator().manual_seed(0))
        before, cache = x.clone(), torch.zeros(2, config.vlm.depth, 40, config.vlm.head_dim)
        rope = forward.rope_of_all_positions(config, 40, x.device)
        ops = dataclasses.replace(PLAIN, add_linear=refused)
        forward.prefix_cache(config, weights, ops, x, torch.tensor([40]), cache[0], cache[1], rope)
        assert torch.equal(x, before)


def adding(every: int) -> Ops:
    """Plain operations that add one of so many products themselves."""
    count = itertools.count()

    def add_linear(stream: Tensor, x: Tensor, weight: Matrix, bias: Tensor | None = None) -> bool:
        if next(count) % every:
            return False
        stream += PLAIN.linear(x, weight, bias)
        return True

    return dataclasses.replace(PLAIN, add_linear=add_linear)


def prefix(ops: Ops, fp8: bool, monkeypatch: pytest.MonkeyPatch, most: int, *, runs: int = 1) -> tuple[Tensor, Tensor]:
    """Keys and values [layer, rows, K] of a batch of made-up tokens, chunks having at most so many rows."""
    monkeypatch.setattr(forward, "MOST_ROWS", most)
    model = golden_model("pi05")
    config = model.config
    weights = pack(config, dict(model.state_dict()), in_fp8 if fp8 else lambda place, matrix: matrix)
    camera_images = Images(config, weights, PLAIN, 6, False, 0)
    camera_images.embs.normal_(generator=torch.Generator().manual_seed(0))
    buffers = BatchBuffers(config, weights, ops, BatchSize(4, 6), camera_images, 160)
    run = PackedPrefix(buffers, 150)
    run.write(CAMERAS, [np.arange(1, count) for count in (40, 47, 20, 30)])
    for _ in range(runs):
        run.run()
    return buffers.cache.k[:, : run.rows], buffers.cache.v[:, : run.rows]


def in_fp8(place: str, matrix: Tensor) -> Matrix:
    return quantize(matrix, 0.05) if place.startswith("prefix") else matrix


def telling(ran: list[tuple[str, int]]) -> Ops:
    """Plain operations of the prefix that tell their names and numbers of rows."""

    def reported(name: str, reference: Any) -> Any:
        def run(x: Tensor, *rest: Any, **more: Any) -> Any:
            ran.append((name, len(x)))
            return reference(x, *rest, **more)

        return run

    return dataclasses.replace(
        PLAIN,
        residual_rms_norm=reported("norm", PLAIN.residual_rms_norm),
        linear=reported("linear", PLAIN.linear),
        residual_linear=reported("residual", PLAIN.residual_linear),
        linear_geglu=reported("geglu", PLAIN.linear_geglu),
        rope_split=reported("rope", PLAIN.rope_split),
    )


class TestImages:
    """In parts, each with a head of its own."""

    @pytest.fixture(autouse=True, params=[1, 3])
    def cut(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
        """The golden models' vision has two layers: all or one of them are the head."""
        monkeypatch.setattr(forward, "HEAD_LAYERS", request.param)

    @pytest.mark.parametrize("count", [3, 4, 7])
    @pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
    def test_tokens_are_those_of_one_part(
        self, count: int, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        weights, side = packed(), golden_model("pi05").config.vision.image_size
        values = torch.randint(0, 256, (count, side, side, 3), generator=torch.Generator().manual_seed(count))
        shown = list(values.to(dtype).numpy() if dtype == torch.uint8 else (values / 128 - 1).numpy())
        found = []
        for part, heads in ((count, 1), (2, -(-count // 2))):
            monkeypatch.setattr(call, "PART", part)
            camera_images = Images(golden_model("pi05").config, weights, PLAIN, count, dtype == torch.float32, 0)
            uploads = camera_images.uploads(shown, None, False)
            assert len(uploads) == heads
            send(camera_images, shown)
            camera_images.run()
            found.append(camera_images.embs)
        assert bool(found[0].isfinite().all()) and torch.equal(*found)

    # the operation that stands in for the device's is openpi's way
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("cut", "cls", "resize"),
        [(1, OnCpu, "openpi"), (3, OnCpu, "lerobot"), (1, Resizing, "openpi")],
        indirect=["cut"],
    )
    def test_actions_are_those_of_one_part(
        self, cls: type[OnCpu], resize: ImageResize, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Images of other sizes among those that fit, resized by the host and by the device, and again by others."""
        made, noise = observations("pi05", CAMERAS, [7, 12, 3, 1], horizon=5)
        side = made.images.shape[2]
        sizes = ((side, side), (30, 50), (side, side), (40, 20))
        backends, single = {part: on_cpu("pi05", cls) for part in (100, 2)}, on_cpu()
        for seed in (0, 4):
            shown = [
                [camera_image(*sizes[(row + camera) % 4], seed=seed + camera) for camera in range(count)]
                for row, count in enumerate(CAMERAS)
            ]
            found = []
            for part, backend in backends.items():
                monkeypatch.setattr(call, "PART", part)
                begun = backend.begin_batch(shown, resize)
                rows = [HostRow.of(made, row) for row in range(4)]
                rest = [row.tokens for row in rows], np.stack([row.state for row in rows]), noise.numpy()
                found.append(begun.finish(*rest, 2).actions)
            assert bool(found[0].isfinite().all()) and torch.equal(*found)
            alone = single.begin([fitted(one, side, resize) for one in shown[2]])
            theirs = alone.finish(rows[2].tokens, rows[2].state, noise[2].numpy(), 2).actions[0]
            torch.testing.assert_close(found[1][2], theirs, atol=2e-5, rtol=2e-5)

    def test_a_part_is_sent_when_the_one_before_it_is_launched(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A graph for each head, and one for the rest; timing begins before anything is sent."""
        monkeypatch.setattr(call, "PART", 2)
        FakeCuda(monkeypatch)
        event = SimpleNamespace(record=lambda stream: DONE.append("event"), elapsed_time=lambda end: 1.0)
        monkeypatch.setattr(torch.cuda, "Event", lambda **options: event)
        write = Part.write

        def telling_write(part: Part, camera_images: Any) -> None:
            DONE.append(f"{len(camera_images)} sent")
            write(part, camera_images)

        monkeypatch.setattr(Part, "write", telling_write)
        config = golden_model("pi05").config
        camera_images = Images(config, packed(), PLAIN, 5, False, 0)
        graph = capture(camera_images.run)
        shown = [camera_image(config.vision.image_size, config.vision.image_size)] * 5
        DONE.clear()
        graph.launch(*camera_images.uploads(shown, None, False))
        assert DONE == ["event", "2 sent", "launched", "2 sent", "launched", "1 sent", "launched", "launched"]
        with pytest.raises(AssertionError, match="5 things to do before 4 graphs"):
            graph.launch(*[lambda: None] * 5)

    @pytest.mark.slow
    @pytest.mark.parametrize("cut", [1], indirect=True)
    def test_a_wrong_picture_of_a_later_part_leaves_the_next_call_right(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(call, "PART", 2)
        made, noise = observations("pi05", CAMERAS, [7, 12, 3, 1], horizon=5)
        rows = [HostRow.of(made, row) for row in range(4)]
        shown = [row.images for row in rows]
        rest = [row.tokens for row in rows], np.stack([row.state for row in rows]), noise.numpy()
        for cls, resize, wrong, error in (
            (OnCpu, None, shown[0][0][:3], "broadcast"),
            (OnCpu, "openpi", camera_image(1, 900), "too narrow"),
            (Resizing, "openpi", camera_image(1, 900), "too narrow"),
        ):
            backend: Any = on_cpu("pi05", cls)
            expected = backend.begin_batch(shown, resize).finish(*rest, 2).actions
            begun = backend.begin_batch(shown, resize)
            with pytest.raises(ValueError, match=error):
                backend.begin_batch([shown[2][:2], [], [shown[0][0], wrong, shown[0][1]], shown[3]], resize)
            with pytest.raises(BackendError, match="begun another"):
                begun.finish(*rest, 2)
            assert torch.equal(backend.begin_batch(shown, resize).finish(*rest, 2).actions, expected)


def packed() -> Weights:
    model = golden_model("pi05")
    return pack(model.config, dict(model.state_dict()))
