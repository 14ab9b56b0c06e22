"""What is measured on a GPU: the operations of the calls that were asked for, each with its candidates."""

import gc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from turbopi.backends.tuned_tiles import Machine
from turbopi.config import ModelConfig, Network
from turbopi.kernels.ops import forced_portable
from turbopi.kernels.portable.gemm.tiles import fp8_refusal
from turbopi.kernels.tile_checks import HOPPER
from turbopi.kernels.tile_table import Kernels, TileKey, TileTable
from turbopi.support.errors import ConfigError
from turbopi.tune import hopper, portable
from turbopi.tune.in_layers import ExpertLayers, InLayers, LayersOf
from turbopi.tune.race import Bench, UsualFails
from turbopi.tune.run import Planned, usual_first
from turbopi.tune.shapes import Call, Operation, Precision, distinct, operations

KERNELS = ("auto", "portable", "hopper", "all")


@dataclass(frozen=True)
class Plan:
    """calls: the operations of each, for what it gains; planned: what has a choice and is measured, each once."""

    calls: Mapping[tuple[Call, Precision, Kernels], Sequence[Operation]]
    planned: Sequence[Planned]


def kernels_to_tune(requested: str, capability: tuple[int, int]) -> list[Kernels]:
    """Whose tiles: "auto" those of the kernels that `fused` takes here. Raises ConfigError."""
    if requested not in KERNELS:
        raise ConfigError(f"--kernels is {requested!r}; expected one of {', '.join(KERNELS)}")
    on_hopper = capability == HOPPER
    if requested == "hopper" and not on_hopper:
        arch = f"{capability[0]}.{capability[1]}"
        raise ConfigError(f"--kernels hopper is for compute capability 9.0; this GPU has {arch}: leave it out")
    if requested == "all":
        return ["hopper", "portable"] if on_hopper else ["portable"]
    if requested == "auto":
        return ["hopper"] if on_hopper and not forced_portable() else ["portable"]
    return ["hopper"] if requested == "hopper" else ["portable"]


def precisions_to_tune(requested: Sequence[str], capability: tuple[int, int]) -> list[Precision]:
    """None asked for: all that this GPU multiplies. Raises ConfigError for others."""
    refusal = fp8_refusal(capability)
    if not requested:
        return ["bf16"] if refusal else ["bf16", "fp8"]
    found: list[Precision] = []
    for name in dict.fromkeys(requested):
        if name not in ("bf16", "fp8"):
            raise ConfigError(f"--precision has {name!r}; tiles are measured for bf16 and fp8")
        if name == "fp8" and refusal:
            raise ConfigError(f"--precision fp8: {refusal}")
        found.append("fp8" if name == "fp8" else "bf16")
    return found


def plan(
    config: Network,
    calls: Sequence[Call],
    precisions: Sequence[Precision],
    kernels: Sequence[Kernels],
    machine: Machine,
    *,
    shipped: TileTable,
    known: TileTable,
    steps: int = 10,
) -> Plan:
    """shipped: tiles that run without a file of one's own; known: what needn't be measured again."""
    sms, found = machine.multiprocessors, dict[tuple[Call, Precision, Kernels], Sequence[Operation]]()
    for call in calls:
        for which in kernels:
            for precision in precisions:
                all_of = operations(config, call, precision, which, steps=steps, horizon=config.action_horizon)
                found[call, precision, which] = [hopper.resolved(one, sms) for one in all_of]
    wanted = distinct([one for several in found.values() for one in several])
    rows = [planned(one, machine, shipped) for one in wanted if one.key not in known.tiles]
    return Plan(found, [one for one in rows if len(one.candidates) > 1])


def planned(one: Operation, machine: Machine, shipped: TileTable) -> Planned:
    if one.kernels == "hopper":
        candidates = hopper.candidates(one, machine.multiprocessors)
    else:
        candidates = portable.candidates(one, machine.capability, machine.multiprocessors)
    key: TileKey = one.key
    return Planned(one, usual_first(candidates, key, shipped))


def bench_maker(config: Network, device: torch.device) -> Callable[[Operation, TileTable], Bench]:
    """What puts an operation's inputs on the device; other operations have those tiles."""
    gc.freeze()  # capturing a graph may collect garbage, each time through all that is imported
    made: dict[LayersOf, ExpertLayers] = {}  # the last ones

    def make(one: Operation, tiles: TileTable) -> Bench:
        try:
            alone = hopper.Product(one, device) if one.kernels == "hopper" else portable.bench(one, device)
            if not one.in_layers:
                return alone
            of = LayersOf.of(one)
            if of not in made:
                assert isinstance(config, ModelConfig), "no other expert is operations"
                made.clear()
                made[of] = ExpertLayers(config, of, device)
            return InLayers(alone, made[of], tiles)
        except torch.OutOfMemoryError as failure:
            raise UsualFails("its inputs don't fit the GPU's free memory") from failure

    return make
