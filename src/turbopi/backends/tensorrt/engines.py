"""The engines of a model in memory: found in the cache, built where that is allowed, counted."""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from turbopi.backends.tensorrt import Library, parts
from turbopi.backends.tensorrt.cache import EngineCache, Environment, Report, default_folder, networks_hash
from turbopi.backends.tensorrt.call import Part, Parts
from turbopi.backends.tensorrt.engine import Engine, Kernels, Specification, build
from turbopi.backends.tensorrt.networks import Fp8Scales
from turbopi.backends.tensorrt.ops import Dtype
from turbopi.backends.tensorrt.parts import EngineShape
from turbopi.config import ModelConfig
from turbopi.engine.weights import Weights
from turbopi.support.errors import BackendError
from turbopi.version import turbopi_version

logger = logging.getLogger(__name__)

BUILDERS = 4  # at once: each holds an engine's weights on the host
Load = Callable[[Specification, bytes], Part]


class ModelEngines:
    """Loads a model's engines, from the cache or newly built.

    `weights` may be let go with `release`: then only what is cached can be loaded.
    """

    def __init__(
        self,
        config: ModelConfig,
        weights: Weights,
        cache: EngineCache,
        *,
        build: Callable[[Specification], bytes],
        load: Load,
        scales: Sequence[Fp8Scales | None] | None = None,
        vision_dtype: Dtype = "f16",
        report: Report = logger.warning,
        loaded: Callable[[], None] = lambda: None,  # called once further engines have been loaded
    ) -> None:
        self.config, self.cache, self.scales, self.vision_dtype = config, cache, scales, vision_dtype
        self.report = report
        self.origin: dict[str, str] = {}  # engine -> "cached" or "built"
        self._weights: Weights | None = weights
        self._build, self._load, self._after_loading = build, load, loaded
        self._loaded: dict[str, Part] = {}
        self._dtype: Dtype = "f32" if weights.embed_tokens.dtype == torch.float32 else "bf16"

    def specifications(self, shape: EngineShape) -> list[Specification]:
        """All engines of a shape."""
        mlps = parts.feed_forwards(self.config, self._get_weights, shape, self._dtype, self.scales)
        step = parts.denoise_step(self.config, self._get_weights, shape, self._dtype)
        return [*self._vision(shape), *mlps, step]

    def prepare(
        self, shape: EngineShape, *, rebuild: bool = False, progress: Callable[[str], None] = lambda name: None
    ) -> None:
        """Have every engine of a shape in the cache; `progress` hears of each one when it is there.

        Raises OutputError if the cache can't be written.
        """

        def one(specification: Specification) -> None:
            _, self.origin[specification.name] = self.cache.get_or_build(
                specification, self._build, self.report, rebuild=rebuild, keep=True
            )
            progress(specification.name)

        with ThreadPoolExecutor(BUILDERS) as pool:
            list(pool.map(one, self.specifications(shape)))

    def parts(self, shape: EngineShape) -> Parts:
        """The engines of a shape, ready to run."""
        vision, step = self._vision(shape), parts.denoise_step(self.config, self._get_weights, shape, self._dtype)
        mlps = parts.feed_forwards(self.config, self._get_weights, shape, self._dtype, self.scales)
        missing = [one for one in (*vision, *mlps, step) if one.name not in self._loaded]
        with ThreadPoolExecutor(BUILDERS) as pool:
            plans = list(pool.map(lambda one: self.cache.get_or_build(one, self._build, self.report), missing))
        for one, (plan, origin) in zip(missing, plans, strict=True):
            self.origin.setdefault(one.name, origin)
            self._loaded[one.name] = self._load(one, plan)
        if missing:
            self._after_loading()
        loaded = self._loaded
        return Parts(loaded[vision[0].name] if vision else None, [loaded[one.name] for one in mlps], loaded[step.name])

    def cached_shapes(self, cameras: int, horizon: int) -> list[EngineShape]:
        """Shapes whose every engine is in the cache under its name, shortest prompts first. They may prove stale."""
        names, found = set(self.cache.names()), []
        for slots in range(parts.SLOTS, 4096, parts.SLOTS):
            shape = EngineShape(cameras, slots, horizon)
            step = parts.denoise_step(self.config, self._get_weights, shape, self._dtype).name
            if step in names and {one.name for one in self.specifications(shape)} <= names:
                found.append(shape)
        return found

    def calls(self) -> dict[str, int]:
        """How often each engine ran or was captured."""
        return {name: part.calls for name, part in self._loaded.items()}

    def release(self) -> None:
        """Let go of the matrices that are inside engines."""
        if self._weights is not None:
            self._weights = None

    def _vision(self, shape: EngineShape) -> list[Specification]:
        return [parts.vision(self.config, self._get_weights, shape, self.vision_dtype)] if shape.cameras else []

    def _get_weights(self) -> Weights:
        if self._weights is None:
            raise BackendError(
                "the weights that engines are built from were let go after warm-up; build engines for further shapes "
                "before that, with `turbopi build`"
            )
        return self._weights


def without_engine_weights(weights: Weights) -> Weights:
    """The weights that a call reads outside its engines."""
    empty = torch.empty(0)
    vlm = [dataclasses.replace(layer, gate_up=empty, down=empty) for layer in weights.vlm]
    return dataclasses.replace(weights, vision=[], vlm=vlm, expert=[])


def for_this_gpu(
    library: Library,
    config: ModelConfig,
    weights: Weights,
    weights_hash: str,
    device: torch.device,
    *,
    folder: Path | None = None,
    **options: Any,
) -> ModelEngines:
    """A model's engines on a GPU with the library that is installed; `options` are ModelEngines's."""
    properties = torch.cuda.get_device_properties(device)
    environment = Environment(
        weights=weights_hash,
        library=library.name,
        library_version=library.version,
        gpu=properties.name,
        compute_capability=f"{properties.major}.{properties.minor}",
        turbopi=turbopi_version(),
        networks=networks_hash(),
    )
    cache = EngineCache(folder or default_folder(), environment)
    kernels = Kernels(library, cache.folder / f"kernels-{properties.name.replace(' ', '_')}-{library.version}.bin")

    def build_here(specification: Specification) -> bytes:  # by threads of a pool, whose current device is the first
        with torch.cuda.device(device):
            return build(library, specification)

    return ModelEngines(
        config,
        weights,
        cache,
        build=build_here,
        load=lambda specification, plan: Engine(library, specification.name, plan, kernels=kernels),
        loaded=kernels.keep,
        **options,
    )
