"""A look at a serialised message before it is parsed: how much of it is structure rather than payload.

An empty sub-message takes two bytes on the wire and fifty or more in memory, so that the length of a message does not
bound what parsing it costs. Structure is bounded here; long ``bytes`` fields (blobs, encoded records) do not count.
"""

from __future__ import annotations

from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from vggt_motion.errors import CodecError

SCANNED_FROM_BYTES = 2**20  # shorter messages cannot hurt
MAX_ELEMENTS = 2**19
MAX_STRUCTURE_BYTES = 32 * 2**20
_OPAQUE_FROM_BYTES = 2**12
_DESCEND_FROM_BYTES = 2**16
_VARINT, _FIXED64, _DELIMITED, _FIXED32 = 0, 1, 2, 5


def check_structure(payload: bytes, descriptor: Any) -> None:
    """Refuse a message that would unfold into far more memory than it is long.

    Raises:
        CodecError: too many elements, too much structure, or not the wire format at all.
    """
    if len(payload) >= SCANNED_FROM_BYTES:
        _Scan(descriptor.full_name).message(payload, 0, len(payload), descriptor)


class _Scan:
    def __init__(self, name: str) -> None:
        self._name = name
        self._elements = 0
        self._structure_bytes = 0

    def message(self, data: bytes, position: int, end: int, descriptor: Any) -> None:
        fields = descriptor.fields_by_number if descriptor is not None else {}
        while position < end:
            begin = position
            tag, position = self._varint(data, position, end)
            if tag >> 3 == 0:
                raise self._malformed()
            kind = tag & 7
            opaque_bytes = 0
            if kind == _VARINT:
                _, position = self._varint(data, position, end)
            elif kind == _FIXED64:
                position += 8
            elif kind == _FIXED32:
                position += 4
            elif kind == _DELIMITED:
                length, position = self._varint(data, position, end)
                if length > end - position:
                    raise self._malformed()
                field = fields.get(tag >> 3)
                if field is not None and field.type == FieldDescriptor.TYPE_MESSAGE and length >= _DESCEND_FROM_BYTES:
                    self.message(data, position, position + length, field.message_type)
                    opaque_bytes = length  # counted inside
                elif length >= _OPAQUE_FROM_BYTES and (field is None or field.type == FieldDescriptor.TYPE_BYTES):
                    opaque_bytes = length
                position += length
            else:
                raise self._malformed()
            self._elements += 1
            self._structure_bytes += position - begin - opaque_bytes
            if self._elements > MAX_ELEMENTS or self._structure_bytes > MAX_STRUCTURE_BYTES:
                raise CodecError(f"{self._name}: has too many elements")
        if position != end:
            raise self._malformed()

    def _varint(self, data: bytes, position: int, end: int) -> tuple[int, int]:
        value = shift = 0
        while position < end and shift < 70:
            byte = data[position]
            position += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value, position
            shift += 7
        raise self._malformed()

    def _malformed(self) -> CodecError:
        return CodecError(f"{self._name}: not a valid message: malformed wire format")
