"""The HTTP application: routes, access, and one form for all errors."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vggt_motion import __version__
from vggt_motion.config import GatewayConfig
from vggt_motion.errors import VggtMotionError
from vggt_motion.gateway.mapping import map_as_ply
from vggt_motion.gateway.metrics import GatewayMetrics
from vggt_motion.gateway.models import ErrorAnswer
from vggt_motion.gateway.results import NothingYetError, Results
from vggt_motion.gateway.routes import events, health, metrics, results, status, viewer
from vggt_motion.gateway.security import AccessControl, check_exposure
from vggt_motion.gateway.state import GatewayState, Snapshot

_log = logging.getLogger(__name__)
_DESCRIPTION = "State, trajectory and map of a running session. World frame: the axes of the first camera, OpenCV's."
_ERRORS: dict[int | str, dict[str, Any]] = {
    400: {"model": ErrorAnswer, "description": "a parameter is wrong; the message says which"},
    401: {"model": ErrorAnswer, "description": "the bearer token is missing or wrong"},
}


def create_app(
    state: GatewayState,
    config: GatewayConfig,
    *,
    build_map: Callable[[Snapshot], bytes] | None = None,
) -> FastAPI:
    """The application that serves a state.

    Args:
        state: of the session; fed by someone else.
        config: address and token.
        build_map: makes the PLY file of a snapshot, in a thread; by default from the payloads that the state can read.

    Raises:
        ConfigurationError: the address can be reached from outside and there is no token.
    """
    check_exposure(config)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        try:
            yield
        finally:
            state.hub.close()

    app = FastAPI(
        title="VGGT-Motion gateway",
        version=__version__,
        description=_DESCRIPTION,
        docs_url=None,  # the stock pages load their script from elsewhere; ours are in static/
        redoc_url=None,
        lifespan=lifespan,
        responses=_ERRORS,
    )
    app.state.gateway = state
    app.state.metrics = GatewayMetrics(state)
    app.state.results = Results(state, build_map or (lambda snapshot: map_as_ply(snapshot, state)))
    for module in (health, status, results, events, metrics, viewer):
        app.include_router(module.router)
    _leave_out_unused_answers(app)
    _add_error_handlers(app)
    app.add_middleware(AccessControl, config=config)
    app.add_middleware(RequestCount, metrics=app.state.metrics)
    return app


def _leave_out_unused_answers(app: FastAPI) -> None:
    """FastAPI declares 422 for every route with parameters; here a wrong one is answered with 400."""
    described = app.openapi

    def describe() -> dict[str, Any]:
        spec = described()
        for path in spec["paths"].values():
            for operation in path.values():
                operation["responses"].pop("422", None)
        return spec

    app.openapi = describe  # type: ignore[method-assign]


class RequestCount:
    """ASGI middleware: counts requests by route and status code."""

    def __init__(self, app: ASGIApp, metrics: GatewayMetrics) -> None:
        """Wrap an application."""
        self._app = app
        self._requests = metrics.requests

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and look at the beginning of the answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def count(message: Message) -> None:
            if message["type"] == "http.response.start":
                # By route and not by path: what strangers ask for must not become labels without end.
                route = getattr(scope.get("route"), "path", "other")
                self._requests.labels(route, str(message["status"])).inc()
            await send(message)

        await self._app(scope, receive, count)


def _add_error_handlers(app: FastAPI) -> None:
    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        return _answer(400, _one_line(error.errors()))

    @app.exception_handler(NothingYetError)
    async def nothing_yet(_: Request, error: NothingYetError) -> JSONResponse:
        return _answer(404, str(error))

    @app.exception_handler(VggtMotionError)
    async def failed(_: Request, error: VggtMotionError) -> JSONResponse:
        return _answer(503, str(error))

    @app.exception_handler(StarletteHTTPException)
    async def refused(_: Request, error: HTTPException) -> JSONResponse:
        return _answer(error.status_code, str(error.detail), error.headers)

    @app.exception_handler(Exception)
    async def defect(request: Request, error: Exception) -> JSONResponse:
        _log.error("request failed", extra={"path": request.url.path}, exc_info=error)
        return _answer(500, "a defect of the gateway; its log has the details")


def _answer(code: int, message: str, headers: Any = None) -> JSONResponse:
    return JSONResponse({"error": " ".join(message.split())[:500]}, code, headers=headers)


def _one_line(errors: Sequence[Any]) -> str:
    first = errors[0]
    *place, name = (str(part) for part in first["loc"])
    given = first.get("input")
    text = f"{' '.join(place)} '{name}': {first['msg'][:1].lower()}{first['msg'][1:]}"
    return f"{text}, not '{given[:50]}'" if isinstance(given, str) else text
