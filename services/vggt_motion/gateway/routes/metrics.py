"""Metrics for Prometheus."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from vggt_motion.gateway.metrics import CONTENT_TYPE, GatewayMetrics

router = APIRouter(tags=["probes"])


@router.get(
    "/metrics",
    summary="Prometheus metrics",
    response_class=Response,
    responses={
        200: {
            "description": "text exposition format",
            "content": {"text/plain": {"example": 'vggt_motion_jobs{kind="predict",state="open"} 1.0\n'}},
        }
    },
)
async def metrics(request: Request) -> Response:
    """The figures of the status, in the form that Prometheus scrapes."""
    exposition: GatewayMetrics = request.app.state.metrics
    return Response(exposition.render(), headers={"Content-Type": CONTENT_TYPE})
