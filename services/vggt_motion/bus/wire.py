"""The wire format of protobuf, as far as messages are looked at without being parsed (protobuf.dev, "Encoding")."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple, TypeAlias

VARINT: Final = 0
FIXED64: Final = 1
DELIMITED: Final = 2
FIXED32: Final = 5
_FIXED_BYTES: Final = {FIXED64: 8, FIXED32: 4}
_MAX_SHIFT = 70  # of a number of ten bytes


class Pieces:
    """Bytes in several places that belong one behind the other; joined only where they have to be."""

    __slots__ = ("parts", "size_bytes")

    def __init__(self, parts: Iterable[bytes | memoryview]) -> None:
        self.parts = tuple(parts)
        self.size_bytes = sum(map(len, self.parts))

    def __len__(self) -> int:
        return self.size_bytes

    def joined(self) -> bytes:
        """The bytes in one place."""
        return b"".join(self.parts)


Payload: TypeAlias = bytes | Pieces
"""What is sent."""


def parts_of(payload: bytes | memoryview | Pieces) -> tuple[bytes | memoryview, ...]:
    """The pieces of what may be one."""
    return payload.parts if isinstance(payload, Pieces) else (payload,)


def joined(payload: Payload) -> bytes:
    """The bytes of what may be in pieces."""
    return payload.joined() if isinstance(payload, Pieces) else payload


class MalformedError(ValueError):
    """Not the wire format, or a group, which nobody writes any more."""


class Field(NamedTuple):
    """One field of a message, by positions in its bytes."""

    number: int
    kind: int  # VARINT, FIXED64, DELIMITED or FIXED32
    begin: int  # of the tag
    content: int  # where the content begins; of a varint, its end
    end: int


def fields(data: bytes | memoryview, begin: int, end: int) -> Iterator[Field]:
    """The fields of the message between two positions, in order.

    Raises:
        MalformedError: see there.
    """
    position = begin
    while position < end:
        first = position
        tag, position = _varint(data, position, end)
        number, kind = tag >> 3, tag & 7
        length = 0
        if kind == DELIMITED:
            length, position = _varint(data, position, end)
        elif kind == VARINT:
            _, position = _varint(data, position, end)
        elif kind in _FIXED_BYTES:
            length = _FIXED_BYTES[kind]
        else:
            raise MalformedError
        if number == 0 or length > end - position:
            raise MalformedError
        yield Field(number, kind, first, position, position + length)
        position += length


def delimited(number: int, length: int) -> bytes:
    """Tag and length of a field that is delimited by its length."""
    out = bytearray()
    for value in (number << 3 | DELIMITED, length):
        while value > 0x7F:
            out.append(value & 0x7F | 0x80)
            value >>= 7
        out.append(value)
    return bytes(out)


def _varint(data: bytes | memoryview, position: int, end: int) -> tuple[int, int]:
    value = shift = 0
    while position < end and shift < _MAX_SHIFT:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise MalformedError
