"""Live events, as server-sent events: plain HTTP that any client reads."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query
from fastapi.responses import StreamingResponse

from vggt_motion.gateway.hub import CLOSED, Subscription
from vggt_motion.gateway.models import ErrorAnswer
from vggt_motion.gateway.routes import NoQuery, State

router = APIRouter(prefix="/api/v1", tags=["session"])

_KEEP_ALIVE_S = 10.0
_EXAMPLE = (
    'id: 41\nevent: keyframe\ndata: {"keyframe_id":"front/0/00000037","frame_index":37,'
    '"capture_time_ns":3836900000,"state":"T"}\n\n'
    'id: 42\nevent: graph\ndata: {"revision":15,"is_final":false,"submaps":8,"components":1,"breaks":0}\n\n'
)


@router.get(
    "/events",
    summary="Live events (SSE)",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "named after the streams of the log: keyframe, segment, submap, constraint, graph, event. "
            "A client that reads too slowly gets the event 'lagged' with the number that it missed, then the newest.",
            "content": {"text/event-stream": {"example": _EXAMPLE}},
        },
        503: {"model": ErrorAnswer, "description": "too many clients"},
    },
)
async def events(state: State, _: Annotated[NoQuery, Query()]) -> StreamingResponse:
    """What happens from now on; for what was before, ask for the status."""
    client = state.hub.subscribe()
    if client is None:
        raise HTTPException(503, "too many clients listen to the live events")
    return StreamingResponse(
        _stream(client),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _stream(client: Subscription) -> AsyncIterator[bytes]:
    try:
        # Lets the client know at once that it is connected, and after which delay to come back.
        yield b"retry: 2000\n\n"
        while True:
            event = await client.next(_KEEP_ALIVE_S)
            if event is None:
                yield b": still here\n\n"
            elif event.name == CLOSED:
                return
            else:
                yield event.encode()
    finally:
        client.close()
