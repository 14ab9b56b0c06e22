"""What a kernel's machine code uses, by cuobjdump, which comes with Triton."""

import re
import subprocess
import tempfile

import triton

USED = re.compile(r"REG:(\d+) STACK:(\d+) SHARED:(\d+)")


def used(cubin: bytes) -> tuple[int, int, int]:
    """(registers a thread, bytes of stack a thread, bytes of fixed shared memory a block), the most of its kernels."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        command = [triton.knobs.nvidia.cuobjdump.path, "--dump-resource-usage", file.name]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = [tuple(int(number) for number in match) for match in USED.findall(text)]
    assert found, f"cuobjdump says nothing of a kernel: {text!r}"
    registers, stack, shared = (max(numbers) for numbers in zip(*found, strict=True))
    return registers, stack, shared
