"""Whole binary frames of a websocket (RFC 6455, 5.2), past the websockets library, which takes up to 30 us for one."""

_BINARY = 0x82  # a message in one frame
_MASKED = 0x80


def head_bytes(length: int) -> int:
    """Of a frame with so many bytes of payload, without its mask."""
    return 2 if length < 126 else 4 if length < 2**16 else 10


def binary_frame(message: bytes, masked: bool = False) -> bytes:
    """The frame of a message. masked: of a client's, with a mask of zeros, which changes nothing."""
    length, mask = len(message), _MASKED if masked else 0
    more = head_bytes(length) - 2
    if more:
        head = bytes((_BINARY, mask | (126 if more == 2 else 127))) + length.to_bytes(more, "big")
    else:
        head = bytes((_BINARY, mask | length))
    return b"".join((head, bytes(4) if masked else b"", message))


def binary_message(data: bytes) -> bytes | None:
    """The message, if the data are one frame of a server and nothing else."""
    if len(data) < 2 or data[0] != _BINARY or data[1] & _MASKED:
        return None
    begin = {126: 4, 127: 10}.get(data[1], 2)
    length = data[1] if begin == 2 else int.from_bytes(data[2:begin], "big")
    return data[begin:] if len(data) == begin + length else None
