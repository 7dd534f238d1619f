"""The state of the session."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from vggt_motion.gateway.models import StatusAnswer
from vggt_motion.gateway.routes import NoQuery, State

router = APIRouter(prefix="/api/v1", tags=["session"])


@router.get("/status", summary="Services, streams, queue, lag, motion states, breaks")
async def status(state: State, _: Annotated[NoQuery, Query()]) -> StatusAnswer:
    """Everything that there is to say about the session at this moment."""
    return state.status()
