"""Trajectory and map."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from vggt_motion.gateway.models import ErrorAnswer
from vggt_motion.gateway.results import FrameChoice, TrajectoryFormat
from vggt_motion.gateway.routes import NoQuery, TheResults

router = APIRouter(prefix="/api/v1", tags=["results"])

_MEDIA_TYPES: dict[TrajectoryFormat, str] = {
    "tum": "text/plain; charset=utf-8",
    "kitti": "text/plain; charset=utf-8",
    "csv": "text/csv; charset=utf-8",
    "json": "application/json",
}
_JSON_EXAMPLE = {
    "schema": "vggt_motion.trajectory/1",
    "graph_revision": 15,
    "is_final": True,
    "scale": 1.0,
    "frames": [
        {
            "camera": "front",
            "epoch": 0,
            "frame_index": 0,
            "capture_time_ns": 0,
            "state": "L",
            "is_keyframe": True,
            "origin": "home",
            "component": 0,
            "world_from_camera": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        }
    ],
}
_TRAJECTORY_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "the trajectory; the header X-Graph-Revision says of which graph, X-Components lists its parts",
        "content": {
            "application/json": {"example": _JSON_EXAMPLE},
            "text/plain": {"example": "0.000000000 0 0 0 0 0 0 1\n0.103700000 0.01 -0.02 1.17 0 0.001 0 0.9999995\n"},
            "text/csv": {
                "example": "camera,epoch,frame_index,capture_time_ns,state,is_keyframe,origin,component,"
                "tx,ty,tz,qx,qy,qz,qw\nfront,0,0,0,L,1,home,0,0,0,0,0,0,0,1\n"
            },
        },
    },
    404: {"model": ErrorAnswer, "description": "no graph yet, or no such component"},
}


class TrajectoryQuery(BaseModel):
    """What to send."""

    model_config = ConfigDict(extra="forbid")

    format: TrajectoryFormat = Field(
        "json", description="tum and kitti hold poses only, csv and json what each frame is, too", examples=["tum"]
    )
    frames: FrameChoice = Field(
        "key", description="keyframes, or every input frame of closed segments", examples=["all"]
    )
    component: int | None = Field(
        None,
        ge=0,
        description="one connected part of a broken trajectory; parts share no frame of reference",
        examples=[0],
    )


@router.get(
    "/trajectory",
    summary="The optimised trajectory",
    response_class=Response,
    responses=_TRAJECTORY_RESPONSES,
)
async def trajectory(results: TheResults, query: Annotated[TrajectoryQuery, Query()]) -> Response:
    """Poses that take points from the camera to the world, OpenCV axes, by the newest graph."""
    text = await results.text(query.format, query.frames, query.component)
    return Response(
        text.body,
        media_type=_MEDIA_TYPES[query.format],
        headers={
            "X-Graph-Revision": str(text.trajectory.graph_revision),
            "X-Is-Final": str(text.trajectory.is_final).lower(),
            "X-Components": ",".join(map(str, text.trajectory.components)),
            "Cache-Control": "no-cache",
        },
    )


@router.get(
    "/map.ply",
    summary="The coloured point cloud",
    response_class=Response,
    responses={
        200: {"description": "binary PLY in the frame of the trajectory", "content": {"application/octet-stream": {}}},
        404: {"model": ErrorAnswer, "description": "no graph yet"},
    },
)
async def map_ply(results: TheResults, _: Annotated[NoQuery, Query()]) -> Response:
    """Confident points of the largest connected part, posed by the newest graph; made on demand and kept."""
    built = await results.map_ply()
    return Response(
        built.value,
        media_type="application/octet-stream",
        headers={"Content-Disposition": 'attachment; filename="map.ply"', "Cache-Control": "no-cache"},
    )
