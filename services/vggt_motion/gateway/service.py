"""The gateway as a service: followers feed the state, uvicorn serves it."""

from __future__ import annotations

import logging
import socket
import threading
import time

import uvicorn
from fastapi import FastAPI

from vggt_motion.bus.follow import Follower
from vggt_motion.bus.liveliness import ServiceWatch
from vggt_motion.bus.log import RECORD_OF_STREAM, LogRecord
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.config import Config, GatewayConfig
from vggt_motion.errors import BusError, ConfigurationError, VggtMotionError
from vggt_motion.gateway.app import create_app
from vggt_motion.gateway.security import check_exposure
from vggt_motion.gateway.state import GatewayState
from vggt_motion.records import BlobRef, Stream

_log = logging.getLogger(__name__)
_POLL_S = 0.05
_STATUS_INTERVAL_S = 1.0
_BLOB_PATIENCE_S = 3.0
_RECORDS_A_TURN = 500
_SHUTDOWN_S = 1.0


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
        self._state = GatewayState(context.config, read_blob=self._read_blob)
        self._app = create_app(self._state, context.config.gateway)

    def serve(self) -> None:
        context = self._context
        watch = ServiceWatch(context.bus)
        followers: dict[Stream, Follower[LogRecord]] = {
            stream: Follower(context.bus, stream, cls) for stream, cls in RECORD_OF_STREAM.items()
        }
        threading.Thread(target=self._watch_ledger, name="gateway-ledger", daemon=True).start()
        server = HttpServer(self._app, self._listener)
        server.start()
        _log.info("serving", extra={"url": self.url})
        try:
            next_report = 0.0
            while not context.stopping.is_set():
                if not server.is_alive:
                    raise VggtMotionError("the HTTP server ended by itself; its log has the reason")
                count = self._take_in(followers)
                if time.monotonic() >= next_report:
                    next_report = time.monotonic() + _STATUS_INTERVAL_S
                    self._take_services(watch)
                    self._report(followers)
                if count == 0:
                    context.stopping.wait(_POLL_S)
        finally:
            # Live clients first: the server waits for open answers.
            self._state.hub.close()
            server.stop()
            for follower in followers.values():
                follower.close()
            watch.close()

    def _take_in(self, followers: dict[Stream, Follower[LogRecord]]) -> int:
        """Apply what has come, a bounded number of records a turn, so that no stream starves another."""
        count = 0
        for stream, follower in followers.items():
            for _ in range(_RECORDS_A_TURN):
                followed = follower.next(0.0)
                if followed is None:
                    break
                self._state.apply(stream, followed.sequence, followed.record)
                count += 1
        return count

    def _report(self, followers: dict[Stream, Follower[LogRecord]]) -> None:
        hub = self._state.hub
        self._context.set_health(
            "working",
            self.url,
            port=self._port,
            live_clients=hub.client_count,
            missed_events=hub.dropped_count,
            skipped_records=sum(follower.skipped_count for follower in followers.values()),
            **{f"position_{stream.value}": follower.position for stream, follower in followers.items()},
        )

    def _take_services(self, watch: ServiceWatch) -> None:
        services = watch.services()
        silences = {name: silence for name in services if (silence := watch.silence_s(*name)) is not None}
        self._state.set_services(services, silences)

    def _watch_ledger(self) -> None:
        """Ask the ledger how it is: beside everything else, which must not wait for a ledger that is silent."""
        while not self._context.stopping.is_set():
            try:
                self._state.set_ledger(self._context.ledger.status())
            except BusError:
                self._state.set_ledger(None)
            self._context.stopping.wait(_STATUS_INTERVAL_S)

    def _read_blob(self, ref: BlobRef) -> bytes:
        return self._context.ledger.blob(ref, patience_s=_BLOB_PATIENCE_S)


class HttpServer:
    """Uvicorn on a listening socket, in a thread of its own; signals are the business of the service scaffold."""

    def __init__(self, app: FastAPI, listener: socket.socket) -> None:
        """Prepare; nothing is served yet."""
        self._listener = listener
        self._server = uvicorn.Server(
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
        self._server.should_exit = True
        self._thread.join(_SHUTDOWN_S)
        self._server.force_exit = True

    def _run(self) -> None:
        self._server.run(sockets=[self._listener])


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).lower()
