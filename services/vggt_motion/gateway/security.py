"""Who may ask the gateway: the local machine, or those who carry the token."""

from __future__ import annotations

import hmac
import ipaddress
import logging

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from vggt_motion.config import GatewayConfig
from vggt_motion.errors import ConfigurationError

_log = logging.getLogger(__name__)
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_exposure(config: GatewayConfig) -> None:
    """Refuse to serve the network without a token.

    Raises:
        ConfigurationError: ``gateway.host`` is reachable from outside and ``gateway.token`` is not set.
    """
    if config.token is None and not is_loopback(config.host):
        raise ConfigurationError(
            f"gateway.host {config.host} can be reached from other machines: set gateway.token (16 characters or more)"
        )


class AccessControl:
    """ASGI middleware: the bearer token for ``/api`` and ``/metrics``, and, without a token, local names only.

    The second rule keeps a web page that the user visits from reaching the gateway under a name of its own that it lets
    point to 127.0.0.1 (DNS rebinding).
    """

    def __init__(self, app: ASGIApp, config: GatewayConfig) -> None:
        """Wrap an application."""
        self._app = app
        self._token = config.token.encode() if config.token is not None else None
        self._local_names = _LOCAL_NAMES | {config.host.lower()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 401 or 403."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        await (self._app if refusal is None else refusal)(scope, receive, send)

    def _refusal(self, scope: Scope) -> JSONResponse | None:
        headers = Headers(scope=scope)
        if self._token is None:
            name = _host_name(headers.get("host", ""))
            if name not in self._local_names:
                return JSONResponse({"error": f"host '{name[:100]}' is not served without a token"}, 403)
            return None
        path = scope["path"]
        if not (path == "/api" or path.startswith("/api/") or path == "/metrics"):
            return None
        scheme, _, token = headers.get("authorization", "").partition(" ")
        # Compared in constant time, so that the answer's delay tells nothing about the token.
        if scheme.lower() == "bearer" and hmac.compare_digest(token.strip().encode(), self._token):
            return None
        return JSONResponse(
            {"error": "a bearer token is needed: Authorization: Bearer TOKEN"}, 401, {"WWW-Authenticate": "Bearer"}
        )


def _host_name(host: str) -> str:
    """Name in a Host header, without the port."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()
