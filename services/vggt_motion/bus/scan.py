"""A look at a serialised message before it is parsed: how much of it is structure rather than payload.

An empty sub-message takes two bytes on the wire and fifty or more in memory, so that the length of a message does not
bound what parsing it costs. Structure is bounded here; long ``bytes`` fields (blobs, encoded records) do not count.
"""

from __future__ import annotations

from typing import Any

from google.protobuf.descriptor import FieldDescriptor

from vggt_motion.bus.wire import DELIMITED, MalformedError, fields
from vggt_motion.errors import CodecError

SCANNED_FROM_BYTES = 2**20  # shorter messages cannot hurt
MAX_ELEMENTS = 2**19
MAX_STRUCTURE_BYTES = 32 * 2**20
_OPAQUE_FROM_BYTES = 2**12
_DESCEND_FROM_BYTES = 2**16


def check_structure(payload: bytes | memoryview, descriptor: Any) -> None:
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

    def message(self, data: bytes | memoryview, begin: int, end: int, descriptor: Any) -> None:
        known = descriptor.fields_by_number if descriptor is not None else {}
        try:
            for found in fields(data, begin, end):
                length = found.end - found.content
                opaque_bytes = 0
                if found.kind == DELIMITED:
                    field = known.get(found.number)
                    kind = FieldDescriptor.TYPE_BYTES if field is None else field.type
                    if field is not None and kind == FieldDescriptor.TYPE_MESSAGE and length >= _DESCEND_FROM_BYTES:
                        self.message(data, found.content, found.end, field.message_type)
                        opaque_bytes = length  # counted inside
                    elif length >= _OPAQUE_FROM_BYTES and kind == FieldDescriptor.TYPE_BYTES:
                        opaque_bytes = length
                self._elements += 1
                self._structure_bytes += found.end - found.begin - opaque_bytes
                if self._elements > MAX_ELEMENTS or self._structure_bytes > MAX_STRUCTURE_BYTES:
                    raise CodecError(f"{self._name}: has too many elements")
        except MalformedError:
            raise CodecError(f"{self._name}: not a valid message: malformed wire format") from None
