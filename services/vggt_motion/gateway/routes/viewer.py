"""The pages for people: the live view, and the interface to try out. Each is one file that loads nothing else."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, Response

router = APIRouter(include_in_schema=False)

_HEADERS = {
    # The pages run their own script and talk to this server, and nothing else.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-cache",
}


@cache
def _page(name: str) -> str:
    return files("vggt_motion.gateway").joinpath("static", name).read_text(encoding="utf-8")


@router.get("/")
async def viewer() -> HTMLResponse:
    """The live view."""
    return HTMLResponse(_page("viewer.html"), headers=_HEADERS)


@router.get("/docs")
async def docs() -> HTMLResponse:
    """The interface, from /openapi.json."""
    return HTMLResponse(_page("docs.html"), headers=_HEADERS)


@router.get("/favicon.ico")
async def icon() -> Response:
    """Browsers ask for one; there is none."""
    return Response(status_code=204)
