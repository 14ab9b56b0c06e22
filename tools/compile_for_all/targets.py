"""The GPUs that kernels are compiled for, and what a block may use there."""

from dataclasses import dataclass

from turbopi.kernels.portable.gemm.tiles import BLOCK_SHARED, Capability

REGISTERS, THREADS = 65536, 1024  # of a multiprocessor; a block's threads at most

MULTIPROCESSORS = {  # of A100, RTX 3090, Orin, RTX 4090, H100, B200, B300, Thor, RTX 5090, GB10
    (8, 0): 108,
    (8, 6): 82,
    (8, 7): 16,
    (8, 9): 128,
    (9, 0): 132,
    (10, 0): 148,
    (10, 3): 148,
    (11, 0): 20,
    (12, 0): 170,
    (12, 1): 48,
}


@dataclass(frozen=True)
class Target:
    capability: Capability

    @property
    def number(self) -> int:
        return self.capability[0] * 10 + self.capability[1]

    @property
    def arch(self) -> str:
        """As compilers name it: "sm_90a"."""
        return f"sm_{self.number}{'a' if self.number >= 90 else ''}"

    @property
    def shared(self) -> int:
        return BLOCK_SHARED[self.capability]


TARGETS = tuple(Target(capability) for capability in MULTIPROCESSORS)


def over_limit(target: Target, registers: int, shared: int, threads: int) -> str | None:
    """What a block uses too much of, in words; None if it fits."""
    if shared > target.shared:
        return f"{shared} bytes of shared memory; {target.arch} gives a block {target.shared}"
    granted = -(-registers // 8) * 8 * threads
    if threads > THREADS or granted > REGISTERS:
        return f"{granted} registers in {threads} threads; {target.arch} has {REGISTERS} and {THREADS}"
    return None
