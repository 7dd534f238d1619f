"""Probes for those who operate the gateway: is it alive, is it ready."""

from __future__ import annotations

from fastapi import APIRouter, Response

from vggt_motion.gateway.models import LivenessAnswer, ReadinessAnswer
from vggt_motion.gateway.routes import State

router = APIRouter(tags=["probes"])


@router.get("/healthz", summary="The process answers")
async def healthz() -> LivenessAnswer:
    """Always 200 while the event loop turns."""
    return LivenessAnswer()


@router.get(
    "/readyz",
    summary="The picture of the session is complete and current",
    responses={503: {"model": ReadinessAnswer, "description": "the ledger is silent, or its log is still being read"}},
)
async def readyz(state: State, response: Response) -> ReadinessAnswer:
    """200 when ready, 503 with the reason when not."""
    readiness = state.readiness()
    if not readiness.is_ready:
        response.status_code = 503
    return readiness
