"""Zero-copy receive: large frames are read from the socket into one buffer.

The websockets library copies a frame's bytes four times on their way from the socket to the message, mostly into memory
that the system must provide anew. An observation with images is one large frame. connection.py receives the payload
of such frames here, past the library: the socket writes into a buffer that is used again and again, and taking the mask
off makes the message.
"""

from websockets.frames import Opcode, apply_mask  # the compiled one, if there is one

from turbopi.realtime.shared_memory import DOORBELL_BYTES

MIN_BYTES = 2**16  # bytes of a payload: what is smaller costs little either way
MAX_BYTES = 4 * 2**20  # larger ones go through the library: so the one buffer stays small


def is_zero_copy(first: int, second: int, length: int) -> bool:
    """Whether a frame that begins a message, with these first two bytes and a payload of `length`, is received here.

    True for a binary message in one frame, masked, without reserved bits, if it is large or may say where in shared
    memory one is. The library gets all others, and checks them.
    """
    ours = first == 0x80 | Opcode.BINARY and second >= 0x80
    return ours and (MIN_BYTES <= length <= MAX_BYTES or length == DOORBELL_BYTES)


class SpareBuffer:
    """Keeps one buffer from one frame for the next: writing into memory that is new costs more than receiving."""

    def __init__(self) -> None:
        self._spare: bytearray | None = None

    def take(self, size: int) -> bytearray:
        """A buffer of at least `size` bytes, whatever they are."""
        spare, self._spare = self._spare, None
        return spare if spare is not None and len(spare) >= size else bytearray(size)

    def give_back(self, buffer: bytearray) -> None:
        """Of two buffers, the larger one stays."""
        if self._spare is None or len(self._spare) < len(buffer):
            self._spare = buffer

    def drop(self) -> None:
        """Free the buffer."""
        self._spare = None


class ZeroCopyFrame:
    """The payload of one frame while it comes. `free` is where its next bytes go, and is empty at its end."""

    def __init__(self, spare: SpareBuffer, length: int, mask: bytes) -> None:
        self._spare, self._length, self._mask = spare, length, mask
        self._buffer = spare.take(length)
        self.free = memoryview(self._buffer)[:length]

    def add(self, data: bytes | memoryview) -> None:
        """Take bytes that were received elsewhere, no more than there is room for."""
        self.free[: len(data)] = data
        self.received(len(data))

    def received(self, size: int) -> None:
        """So many bytes were written into `free`."""
        self.free = self.free[size:]

    def message(self) -> bytes:
        """The payload without its mask. To be called once: then the buffer is the next frame's."""
        assert not self.free
        message = apply_mask(memoryview(self._buffer)[: self._length], self._mask)
        self._spare.give_back(self._buffer)
        return message
