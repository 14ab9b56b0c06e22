"""Which errors of a GPU are for good, and how a process finds out.

Some CUDA errors stick to the process: every later call returns the same error, and only a new process can use the GPU
again. All others leave the GPU as it was. Nothing here is called unless a backend has failed already.
"""

import torch

from turbopi.engine.graph import CAPTURING
from turbopi.support.errors import BackendUnavailable, DeviceLost

# By number, which the runtime (cudaError_t) and the driver (CUresult) share. Source: "Data types used by CUDA Runtime",
# cudaError, CUDA 13: those of which it says that the process must be terminated and relaunched, and uncorrectable
# errors of memory and NVLink and a destroyed context, after which nothing can be relied upon.
STICKY = {
    214: "cudaErrorECCUncorrectable",
    220: "cudaErrorNvlinkUncorrectable",
    226: "cudaErrorContained",
    700: "cudaErrorIllegalAddress",
    702: "cudaErrorLaunchTimeout",
    709: "cudaErrorContextIsDestroyed",
    710: "cudaErrorAssert",
    714: "cudaErrorHardwareStackError",
    715: "cudaErrorIllegalInstruction",
    716: "cudaErrorMisalignedAddress",
    717: "cudaErrorInvalidAddressSpace",
    718: "cudaErrorInvalidPc",
    719: "cudaErrorLaunchFailure",  # a kernel's own `trap` as well
    721: "cudaErrorTensorMemoryLeak",
    810: "cudaErrorMpsClientTerminated",
    911: "cudaErrorExternalDevice",
}
_OUT_OF_MEMORY = 2
_CAPTURING = range(900, 909)  # cudaErrorStreamCapture…, cudaErrorCapturedEvent
# The same as the driver, or cudaGetErrorString, writes them: of PyTorch's messages before 2.8, Triton's, TensorRT's.
_SAID = {
    214: ("CUDA_ERROR_ECC_UNCORRECTABLE", "uncorrectable ECC error"),
    220: ("CUDA_ERROR_NVLINK_UNCORRECTABLE", "uncorrectable NVLink error"),
    226: ("CUDA_ERROR_CONTAINED",),
    700: ("CUDA_ERROR_ILLEGAL_ADDRESS", "an illegal memory access was encountered"),
    702: ("CUDA_ERROR_LAUNCH_TIMEOUT", "the launch timed out and was terminated"),
    709: ("CUDA_ERROR_CONTEXT_IS_DESTROYED", "context is destroyed"),
    710: ("CUDA_ERROR_ASSERT", "device-side assert triggered"),
    714: ("CUDA_ERROR_HARDWARE_STACK_ERROR", "hardware stack error"),
    715: ("CUDA_ERROR_ILLEGAL_INSTRUCTION", "an illegal instruction was encountered"),
    716: ("CUDA_ERROR_MISALIGNED_ADDRESS", "misaligned address"),
    717: ("CUDA_ERROR_INVALID_ADDRESS_SPACE", "operation not supported on global/shared address space"),
    718: ("CUDA_ERROR_INVALID_PC", "invalid program counter"),
    719: ("CUDA_ERROR_LAUNCH_FAILED", "unspecified launch failure"),
    721: ("CUDA_ERROR_TENSOR_MEMORY_LEAK",),
    810: ("CUDA_ERROR_MPS_CLIENT_TERMINATED", "MPS client has been terminated"),
    911: ("CUDA_ERROR_EXTERNAL_DEVICE",),
}
_PHRASES = {phrase.lower(): number for number, said in _SAID.items() for phrase in (STICKY[number], *said)}
ADVICE = "this process can't use the GPU any more: start it again"


class Guard:
    """`with guard:` around whatever uses the device: a call that fails for good raises DeviceLost, and so does every
    later one, at once and without touching the device. `lost` says why, None while the device works.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.lost: str | None = None

    def refuse_if_lost(self) -> None:
        if self.lost is not None:
            raise DeviceLost(self.lost)

    def examine(self, error: BaseException) -> None:
        """Raise DeviceLost if a call that raised `error` was the last one; else return, for the caller to raise it."""
        if self.lost is None:
            self.lost = why_lost(error, self._device)
        if self.lost is not None:
            raise DeviceLost(self.lost) from error

    def __enter__(self) -> None:
        self.refuse_if_lost()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is not None:
            self.examine(error)


def why_lost(error: BaseException, device: torch.device) -> str | None:
    """Why no later call on this device can work, after a call that raised `error`; None: the device is as before.

    An error that isn't known is put to the test: the device is asked to synchronise, which waits for what runs on it.
    """
    if isinstance(error, DeviceLost):
        return str(error)
    said, number = _first_line(error), _sticky_number(error)
    if number is None:
        found = _probe(device) if device.type == "cuda" and _may_be_the_devices(error) else None
        if found is None:
            return None
        said, number = f"{said}; after it, {_first_line(found)}", _sticky_number(found)
    name = "" if number is None else f" ({STICKY[number]}, {number})"
    return f"the GPU {device} failed: {said}{name}; {ADVICE}"


def _first_line(error: BaseException) -> str:
    """What PyTorch says about an error, without its advice to debuggers."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__


def _sticky_number(error: BaseException) -> int | None:
    """The number of a sticky CUDA error, from PyTorch's `error_code` or else from the message."""
    if not isinstance(error, RuntimeError):
        return None
    code = getattr(error, "error_code", None)
    if code in STICKY:
        return int(code)
    text = str(error).lower()
    return next((number for phrase, number in _PHRASES.items() if phrase in text), None)


def _may_be_the_devices(error: BaseException) -> bool:
    """Whether an error may come from the GPU. Those of PyTorch, Triton, TensorRT and our kernels are RuntimeErrors."""
    if not isinstance(error, RuntimeError) or isinstance(error, torch.OutOfMemoryError | BackendUnavailable):
        return False
    text = str(error).lower()  # the driver writes OUT_OF_MEMORY
    return getattr(error, "error_code", None) != _OUT_OF_MEMORY and "out of memory" not in text.replace("_", " ")


def _probe(device: torch.device) -> RuntimeError | None:
    """What the device answers to a synchronise; None: it works, or a graph is being captured, which forbids to ask."""
    try:
        with CAPTURING:  # our own threads don't
            torch.cuda.synchronize(device)
    except RuntimeError as error:
        if getattr(error, "error_code", None) in _CAPTURING or "captur" in str(error):
            return None
        return error
    return None
