"""Taking what is megabytes long out of a serialised message, so that parsing does not copy it twice."""

from __future__ import annotations

from vggt_motion.bus.schema import Plan, Sub
from vggt_motion.bus.wire import DELIMITED, MalformedError, delimited, fields

LIFTED_FROM_BYTES = 2**16  # below this the copies cost less


def lift(payload: bytes | memoryview, plan: Plan) -> tuple[bytes | memoryview, tuple[memoryview, ...] | None]:
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
    except MalformedError:
        return payload, None
    return head, tuple(contents)


def _lift(data: memoryview, plan: Plan) -> tuple[bytes, list[memoryview]]:
    number, rule = plan.bulk_field
    head: list[bytes | memoryview] = []
    contents: list[memoryview] = []
    kept_to = 0
    for found in fields(data, 0, len(data)):
        if (found.number, found.kind) != (number, DELIMITED):
            continue
        head.append(data[kept_to : found.begin])
        content = data[found.content : found.end]
        if isinstance(rule, Sub):
            inner, deeper = _lift(content, rule.plan)
            head += [delimited(number, len(inner)), inner]
            contents += deeper
        else:
            contents.append(content)
        kept_to = found.end
    head.append(data[kept_to:])
    return b"".join(head), contents
