"""Backend `onnx`: the exported graphs in ONNX Runtime on the CPU, float32. It shows that an export computes the model.

The host does what has no weights: it leaves out masked cameras and padding (exactly), embeds the time and integrates.
Batches run one observation after the other.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from turbopi.backends.base import Backend, LoadState, Precision, Sample, StageTimer
from turbopi.backends.onnx.cache import cached_export
from turbopi.backends.onnx.export import EXPORT_NEEDS, missing_library
from turbopi.checkpoint.onnx_folder import GRAPHS, Export, GraphsOnly, open_export
from turbopi.models import family_of
from turbopi.models.observation import Observation
from turbopi.models.pi0.conditioning import Conditionings
from turbopi.models.pi0.denoise import euler_step, time_embedding, time_grid
from turbopi.models.pi0.kv_cache import EmbeddedPrefix, KVCache, PrefixLayout
from turbopi.models.pi0.reference import Pi0Model, Trace
from turbopi.models.pi0.vision import normalize_images
from turbopi.support.errors import CheckpointError, ObservationError

# the batch axis of what `intermediates` returns
_BATCH_AXIS = {"prefix_embs": 0, "prefix_pad_mask": 0, "prefix_positions": 0, "kv_k": 1, "kv_v": 1}
_BATCH_AXIS |= {"x_t": 1, "v_t": 1, "actions": 0}


class Sessions:
    """ONNX Runtime around the graphs of an exported folder, with as many threads as PyTorch has."""

    def __init__(self, export: Export) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # four pools, one works at a time
        # it would fuse FP8 pairs into an integer product, and then refuse that (1.30)
        options.add_session_config_entry("session.disable_quant_qdq", "1")
        options.log_severity_level = 3  # errors
        self._sessions = {}
        for name in GRAPHS:
            file = export.graph(name)
            try:
                session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
            except Exception as error:  # its errors have no common base
                raise CheckpointError(f"{file}: ONNX Runtime can't load it ({error}); export again") from error
            self._sessions[name] = session

    def run(self, graph: str, **inputs: Tensor) -> list[Tensor]:
        """A graph's outputs."""
        outputs = self._sessions[graph].run(None, {name: value.contiguous().numpy() for name, value in inputs.items()})
        return [torch.from_numpy(output) for output in outputs]


class OnnxBackend(Backend):
    """Runs the export of the weights, which is kept for the next start, or a folder that was exported before.

    That folder is opened as a checkpoint, or with `open`.
    """

    name: ClassVar[str] = "onnx"
    precisions: ClassVar[tuple[Precision, ...]] = ("f32",)

    def load_weights(self, load: LoadState) -> None:
        began, config = time.perf_counter(), self.config
        try:
            model = Pi0Model.from_state(config, load(self.device, "f32"))
        except GraphsOnly as exported:
            self._use(open_export(exported.folder))
            self.config = config  # the graphs' sizes; horizon and time grid as the folder's turbopi.json says
            self._about |= {"load_seconds": round(time.perf_counter() - began, 3), "weight_bytes": self._export.bytes}
        else:
            self._use(cached_export(model))
            self._about["kept"] = True

    @classmethod
    def open(cls, folder: str | Path) -> "OnnxBackend":
        """The backend around a folder that `turbopi export onnx` wrote. Raises what `open_export` raises."""
        backend = cls.__new__(cls)
        backend._use(open_export(folder))
        return backend

    def _use(self, export: Export) -> None:
        self.config, self.device, self.precision = export.config, torch.device("cpu"), self.precisions[0]
        self._about = {name: export.manifest[name] for name in ("opset", "weights_sha256", "versions")}
        self._about["export"] = str(export.folder)
        self._export = export
        self._sessions = Sessions(export)

    @classmethod
    def unavailable(cls, device: torch.device) -> str | None:
        if device.type != "cpu":
            return "it runs ONNX Runtime's CPU provider; use device 'cpu'"
        return missing_library((*EXPORT_NEEDS, "onnxruntime"))

    def prefix(self, observation: Observation) -> KVCache:
        caches = [self._keys_values(self._embed(row)) for row in _rows(observation.to(self.device))]
        return caches[0] if len(caches) == 1 else _batched(caches)

    def denoise(self, cache: KVCache, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None) -> Tensor:
        self.check_conditioning(conditioning)
        noise = noise.to(self.device)
        rows = range(noise.shape[0])
        return torch.cat([self._denoise(_row_of(cache, b), noise[b : b + 1], num_steps) for b in rows])

    def sample(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Sample:
        self.check_conditioning(conditioning)
        noise = noise.to(self.device)
        timer = StageTimer(self.device)
        embedded = [self._embed(row) for row in _rows(observation.to(self.device))]
        timer.mark("vision")  # with the prompt's embedding lookup
        caches = [self._keys_values(row) for row in embedded]
        timer.mark("prefix")
        actions = [self._denoise(cache, noise[b : b + 1], num_steps) for b, cache in enumerate(caches)]
        timer.mark("denoise")
        return Sample(torch.cat(actions), timer.milliseconds())

    def intermediates(
        self, observation: Observation, noise: Tensor, num_steps: int, *, conditioning: Conditionings = None
    ) -> Trace:
        self.check_conditioning(conditioning)
        traces: list[Trace] = []
        for b, row in enumerate(_rows(observation.to(self.device))):
            trace: Trace = {}
            cache = self._keys_values(self._embed(row, trace), trace)
            self._denoise(cache, noise[b : b + 1].to(self.device), num_steps, trace)
            traces.append(trace)
        times = {"times": traces[0]["times"]}
        return {name: torch.cat([t[name] for t in traces], dim=axis) for name, axis in _BATCH_AXIS.items()} | times

    def describe(self) -> dict[str, Any]:
        import onnxruntime

        return {"runtime": f"ONNX Runtime {onnxruntime.__version__}, CPU provider", **self._about}

    # -- one observation -----------------------------------------------------------------------------------------------

    def _embed(self, row: Observation, trace: Trace | None = None) -> EmbeddedPrefix:
        """The embeddings of an observation's valid cameras and tokens, in order."""
        layout = PrefixLayout.of(row, self.config.vision.num_tokens, compact=True)
        lengths = layout.pad_mask.sum(1)
        if not int(lengths):
            raise ObservationError("an observation without any valid camera or prompt token has nothing to attend to")
        parts = []
        if row.image_mask.any():
            images = normalize_images(row.images[row.image_mask])
            parts.append(self._sessions.run("vision", images=images)[0].flatten(0, 1)[None])
        if row.token_mask.any():
            parts.append(self._sessions.run("prompt", tokens=row.tokens[row.token_mask][None])[0])
        embs = torch.cat(parts, dim=1)
        if trace is not None:
            trace["prefix_embs"] = layout.to_padded(embs, 1)
            trace["prefix_pad_mask"], trace["prefix_positions"] = layout.pad_mask, layout.positions
        return EmbeddedPrefix(embs, layout, lengths, row.state)

    def _keys_values(self, embedded: EmbeddedPrefix, trace: Trace | None = None) -> KVCache:
        layout = embedded.layout
        positions = layout.computed_positions
        mask = torch.ones_like(positions, dtype=torch.bool)
        k, v = self._sessions.run("prefix", embs=embedded.embs, positions=positions, mask=mask)
        if trace is not None:
            trace["kv_k"] = layout.to_padded(k, 3).transpose(2, 3)
            trace["kv_v"] = layout.to_padded(v, 3).transpose(2, 3)
        return KVCache(k, v, None, embedded.lengths, embedded.state)

    def _denoise(self, cache: KVCache, noise: Tensor, num_steps: int, trace: Trace | None = None) -> Tensor:
        times = time_grid(num_steps, self.config.time_grid)
        time_embs = time_embedding(times, self.config.expert.width)
        has_state = family_of(self.config).state_token
        fixed = {
            "k": cache.k,
            "v": cache.v,
            "mask": torch.ones(1, cache.k.shape[3], dtype=torch.bool) if cache.mask is None else cache.mask,
            "positions": cache.lengths[:, None] + torch.arange(noise.shape[1] + has_state),
        }
        if has_state:
            fixed["state"] = cache.state
        x_t, v_t = [noise], []
        for i in range(num_steps):
            v_t += self._sessions.run("denoise_step", x_t=x_t[-1], time_emb=time_embs[i : i + 1], **fixed)
            x_t.append(euler_step(x_t[-1], v_t[-1], num_steps))
        if trace is not None:
            trace["times"], trace["x_t"], trace["v_t"] = torch.from_numpy(times), torch.stack(x_t), torch.stack(v_t)
            trace["actions"] = x_t[-1]
        return x_t[-1]


def _rows(observation: Observation) -> Iterator[Observation]:
    """The observations of a batch, as batches of one."""
    return map(observation.row, range(observation.batch_size))


def _batched(caches: list[KVCache]) -> KVCache:
    """One cache of several, with zeros and a mask behind the shorter ones."""
    lengths = torch.cat([cache.lengths for cache in caches])
    longest = int(lengths.max())

    def padded(x: Tensor) -> Tensor:
        return torch.nn.functional.pad(x, (0, 0, 0, longest - x.shape[3]))

    return KVCache(
        torch.cat([padded(cache.k) for cache in caches], dim=1),
        torch.cat([padded(cache.v) for cache in caches], dim=1),
        torch.arange(longest)[None] < lengths[:, None],
        lengths,
        torch.cat([cache.state for cache in caches]),
    )


def _row_of(cache: KVCache, b: int) -> KVCache:
    """One observation's part of a batched cache."""
    one = slice(b, b + 1)
    mask = None if cache.mask is None else cache.mask[one]
    return KVCache(cache.k[:, one], cache.v[:, one], mask, cache.lengths[one], cache.state[one])
