"""Taking what is megabytes long out of a serialised message, so that parsing does not copy it twice."""

from __future__ import annotations

from vggt_motion.bus.schema import Plan, Sub, delimited

LIFTED_FROM_BYTES = 2**16  # below this the copies cost less
_VARINT, _FIXED64, _DELIMITED, _FIXED32 = 0, 1, 2, 5


def lift(payload: bytes, plan: Plan) -> tuple[bytes, tuple[memoryview, ...] | None]:
    """Part a message from the contents of its bulk field.

    Args:
        payload: serialised message.
        plan: of a message with a bulk field: repeated bytes, or a message that has one.

    Returns:
        The message without these contents, and views of them in the payload; the payload as it is and None where
        its wire format is not as expected: what is wrong with it the parser shall say.
    """
    try:
        head, contents = _lift(memoryview(payload), plan)
    except _UnexpectedError:
        return payload, None
    return head, tuple(contents)


class _UnexpectedError(ValueError):
    """Malformed, or of a kind that we do not write."""


def _lift(data: memoryview, plan: Plan) -> tuple[bytes, list[memoryview]]:
    number, rule = plan.bulk_field
    head: list[bytes | memoryview] = []
    contents: list[memoryview] = []
    position = kept_to = 0
    while position < len(data):
        begin = position
        tag, position = _varint(data, position)
        kind = tag & 7
        if kind == _DELIMITED:
            length, position = _varint(data, position)
        elif kind == _VARINT:
            _, position = _varint(data, position)
            length = 0
        elif kind in (_FIXED64, _FIXED32):
            length = 8 if kind == _FIXED64 else 4
        else:
            raise _UnexpectedError
        end = position + length
        if end > len(data):
            raise _UnexpectedError
        if tag == number << 3 | _DELIMITED:
            head.append(data[kept_to:begin])
            if isinstance(rule, Sub):
                inner, found = _lift(data[position:end], rule.plan)
                head += [delimited(number, len(inner)), inner]
                contents += found
            else:
                contents.append(data[position:end])
            kept_to = end
        position = end
    head.append(data[kept_to:])
    return b"".join(head), contents


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70 and position < len(data):
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise _UnexpectedError
