"""The gateway as a service: followers feed the state, uvicorn serves it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import time

import uvicorn
from fastapi import FastAPI

from vggt_motion.bus.liveliness import ServiceWatch
from vggt_motion.bus.log import LogFollower
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.config import Config, GatewayConfig
from vggt_motion.errors import ConfigurationError, VggtMotionError
from vggt_motion.gateway.app import create_app
from vggt_motion.gateway.security import check_exposure
from vggt_motion.gateway.state import GatewayState
from vggt_motion.records import BlobRef

_log = logging.getLogger(__name__)
_STATUS_INTERVAL_S = 1.0
_LEDGER_INTERVAL_S = 2.0
_BLOB_PATIENCE_S = 3.0
_RECORDS_A_TURN = 500
_SHUTDOWN_S = 1.0
_HTTP_TICK_S = 5.0  # answers carry a date that is at most so old


def main(config: Config) -> int:
    """Serve until told to stop; returns the exit code of the process.

    Raises:
        ConfigurationError: the address needs a token, or cannot be listened on.
    """
    check_exposure(config.gateway)
    listener = bind(config.gateway)
    try:
        return run_service("gateway", config, lambda context: _Gateway(context, listener).serve())
    finally:
        listener.close()


def bind(config: GatewayConfig) -> socket.socket:
    """Listen on the configured address, before anything else is started.

    Raises:
        ConfigurationError: the port is taken, or the address is none of ours.
    """
    place = f"{config.host} port {config.port}"
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            config.host, config.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        raise ConfigurationError(f"gateway.host {config.host} is not an address: {_reason(error)}") from error
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        listener.close()
        raise ConfigurationError(
            f"the gateway cannot listen on {place}: {_reason(error)}; choose another with gateway.port, 0 for any"
        ) from error
    return listener


class _Gateway:
    def __init__(self, context: ServiceContext, listener: socket.socket) -> None:
        self._context = context
        self._listener = listener
        host, port = listener.getsockname()[:2]
        self._port = port
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        self._watch = ServiceWatch(context.bus)
        self._state = GatewayState(context.config, read_blob=self._read_blob, look_at_services=self._look_at_services)
        self._app = create_app(self._state, context.config.gateway)

    def serve(self) -> None:
        context = self._context
        log = LogFollower(context.bus, on_status=self._state.set_ledger, interval_s=_LEDGER_INTERVAL_S)
        context.stopping.wakes(log.wake)
        server = HttpServer(self._app, self._listener)
        server.start()
        _log.info("serving", extra={"url": self.url})
        try:
            next_report = 0.0
            while not context.stopping.is_set():
                if not server.is_alive:
                    raise VggtMotionError("the HTTP server ended by itself; its log has the reason")
                count = self._take_in(log)
                if time.monotonic() >= next_report:
                    next_report = time.monotonic() + _STATUS_INTERVAL_S
                    self._report(log)
                if count == 0:
                    log.wait(_STATUS_INTERVAL_S)
        finally:
            # Live clients first: the server waits for open answers.
            self._state.hub.close()
            server.stop()
            log.close()
            self._watch.close()

    def _take_in(self, log: LogFollower) -> int:
        """Apply what has come, a bounded number of records a turn, so that no stream starves another."""
        count = 0
        for stream, follower in log.followers.items():
            for _ in range(_RECORDS_A_TURN):
                followed = follower.next(0.0)
                if followed is None:
                    break
                self._state.apply(stream, followed.sequence, followed.record)
                count += 1
        return count

    def _report(self, log: LogFollower) -> None:
        hub = self._state.hub
        self._context.set_health(
            "working",
            self.url,
            port=self._port,
            live_clients=hub.client_count,
            missed_events=hub.dropped_count,
            skipped_records=sum(follower.skipped_count for follower in log.followers.values()),
            **{f"position_{stream.value}": position for stream, position in log.positions().items()},
        )

    def _look_at_services(self) -> None:
        services = self._watch.services()
        silences = {name: silence for name in services if (silence := self._watch.silence_s(*name)) is not None}
        self._state.set_services(services, silences)

    def _read_blob(self, ref: BlobRef) -> bytes:
        return self._context.ledger.blob(ref, patience_s=_BLOB_PATIENCE_S)


class HttpServer:
    """Uvicorn on a listening socket, in a thread of its own; signals are the business of the service scaffold."""

    def __init__(self, app: FastAPI, listener: socket.socket) -> None:
        """Prepare; nothing is served yet."""
        self._listener = listener
        self._server = _HttpLoop(
            uvicorn.Config(
                app,
                log_config=None,
                log_level="warning",
                access_log=False,
                server_header=False,
                timeout_graceful_shutdown=1,
                timeout_keep_alive=10,
                limit_concurrency=256,
            )
        )
        self._thread = threading.Thread(target=self._run, name="gateway-http", daemon=True)

    def start(self) -> None:
        """Serve from now on."""
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether it still serves."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Finish what is being answered, for a second at most."""
        self._server.ask_to_end()
        self._thread.join(_SHUTDOWN_S)
        self._server.force_exit = True

    def _run(self) -> None:
        self._server.run(sockets=[self._listener])


class _HttpLoop(uvicorn.Server):
    """Uvicorn's server, whose own loop looks ten times a second whether it shall end: this one is told."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending = asyncio.Event()

    def ask_to_end(self) -> None:
        """From any thread."""
        self.should_exit = True
        loop = self._loop
        if loop is not None:
            with contextlib.suppress(RuntimeError):  # it has ended already
                loop.call_soon_threadsafe(self._ending.set)

    async def main_loop(self) -> None:
        self._loop = asyncio.get_running_loop()
        while not await self.on_tick(0):  # 0: renew the date that answers carry
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ending.wait(), _HTTP_TICK_S)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()
