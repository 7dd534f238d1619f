"""Joining the bus: our Zenoh configuration, and the session behind a small interface.

The settings follow measurements: shared memory can lose data and leaks segments of killed processes, multicast and
gossip find strangers, a link lease of 10 s is too long to notice a frozen peer, and a sign of life every fourth part of
the lease is a quarter of what an idle service costs.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import zenoh

from vggt_motion.bus import calls, codec
from vggt_motion.bus.delivery import PolledAnswer, WokenAnswer
from vggt_motion.bus.keys import Keys
from vggt_motion.bus.parcels import Parcels, open_parcels
from vggt_motion.bus.pubsub import (
    MAX_PAYLOAD_BYTES,
    Closable,
    LivelinessSubscription,
    Publisher,
    Sample,
    Subscription,
    Token,
)
from vggt_motion.bus.serving import (
    BUNDLE_ENCODING,
    REFUSAL_ENCODING,
    BatchHandler,
    Handler,
    PromptServer,
    Server,
    SleepingServer,
    error_of,
)
from vggt_motion.bus.wire import Payload, joined
from vggt_motion.config import BusConfig
from vggt_motion.errors import BusError, BusUnavailableError, CodecError, ConfigurationError, VggtMotionError
from vggt_motion.gathering import Gathering

__all__ = ["Bus", "Closable", "EndpointTakenError", "Sample", "open_bus", "zenoh_config"]

_log = logging.getLogger(__name__)
_ATTEMPT_S = 1.0
_RETRY_S = 0.2
_CLOSE_S = 1.0
_HANDLERS_S = 0.3
_MESSAGES_ONLY_S = 30.0
_NO_PARCELS = Parcels()
_BUNDLED_BYTES = 2**20  # longer requests go alone: what each costs apart from its bytes is little then
_MAX_BUNDLE_BYTES = 8 * 2**20
_MAX_BUNDLED = 64
_MIN_BUNDLE_BYTES = _MAX_BUNDLE_BYTES // _MAX_BUNDLED  # a single request, as each counts for so much at least
_SIGNS_OF_LIFE_PER_LEASE = 2  # over a stream none is lost, only late: by half a lease it may be
_BUNDLES_UNDER_WAY = 2  # one travels while the other one is being answered
Kept = TypeVar("Kept", bound=Closable)


class EndpointTakenError(ConfigurationError):
    """The router's endpoint cannot be listened on."""


def zenoh_config(config: BusConfig, mode: Literal["client", "router"] = "client") -> zenoh.Config:
    """Our Zenoh configuration, on top of the user's file if there is one.

    Raises:
        ConfigurationError: Zenoh does not accept the file or the endpoint.
    """
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": config.shared_memory,
        "transport/link/tx/lease": round(config.lease_s * 1000),
        "transport/link/tx/keep_alive": _SIGNS_OF_LIFE_PER_LEASE,
    }
    if mode == "router":
        settings["listen/endpoints"] = [config.endpoint]
        settings["listen/timeout_ms"] = 0
        settings["listen/exit_on_failure"] = True
    else:
        settings["connect/endpoints"] = [config.endpoint]
        settings["connect/timeout_ms"] = round(_ATTEMPT_S * 1000)
        # As one object: inserted one by one, each value alone contradicts the defaults of the others.
        settings["connect/retry"] = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    try:
        merged = zenoh.Config() if config.zenoh_config is None else zenoh.Config.from_file(config.zenoh_config)
        for key, value in settings.items():
            merged.insert_json5(key, json.dumps(value))
    except (zenoh.ZError, OSError) as error:
        place = f"bus.endpoint {config.endpoint}" if config.zenoh_config is None else f"{config.zenoh_config}"
        raise ConfigurationError(f"{place}: not accepted by Zenoh: {_reason(error)}") from None
    return merged


def open_bus(
    config: BusConfig,
    mode: Literal["client", "router"] = "client",
    *,
    stopping: threading.Event | None = None,
) -> Bus:
    """Join the bus.

    Args:
        config: endpoint, session and timeouts.
        mode: "client" connects to the router and tries for ``connect_timeout_s``; "router" is the router.
        stopping: ends the attempts early.

    Raises:
        BusUnavailableError: no router answers at the endpoint.
        EndpointTakenError: as a router: the endpoint cannot be listened on.
        ConfigurationError: the configuration is not accepted.
    """
    settings = zenoh_config(config, mode)
    if mode == "router":
        try:
            return Bus(zenoh.open(settings), config)
        except zenoh.ZError as error:
            problem = "is already in use" if "in use" in str(error) else f"cannot be used: {_reason(error)}"
            raise EndpointTakenError(f"endpoint {config.endpoint} {problem}") from None
    deadline = time.monotonic() + config.connect_timeout_s
    while True:
        try:
            return Bus(zenoh.open(settings), config)
        except zenoh.ZError as error:
            if "Unable to connect" not in str(error) and "imeout" not in str(error):
                raise ConfigurationError(f"bus.endpoint {config.endpoint}: {_reason(error)}") from None
        if stopping is not None and stopping.is_set():
            raise BusUnavailableError(f"stopped while waiting for a router at {config.endpoint}")
        if time.monotonic() >= deadline:
            raise BusUnavailableError(f"no router at {config.endpoint} within {config.connect_timeout_s:g} s")
        (stopping or threading.Event()).wait(_RETRY_S)


class Bus:
    """One session on the bus. Thread-safe; everything that was declared through it ends with it."""

    def __init__(self, session: zenoh.Session, config: BusConfig) -> None:
        """Wrap an open session; use :func:`open_bus`."""
        self.config = config
        self.keys = Keys(config.session)
        self._session = session
        self._parcels = open_parcels(config)
        self._near_keys: set[str] = set()  # who answered there last takes parcels
        self._messages_until_s = 0.0  # after a parcel that came to nothing
        self._lock = threading.Lock()
        self._requests = zenoh.CancellationToken()  # of all: what is asked after it was cancelled ends at once
        self._closables: list[Closable] = []
        self._bundle_bytes = _MAX_BUNDLE_BYTES  # of one message, as far as the link has shown that it carries it
        self._gatherings: dict[str, Gathering[Payload, bytes | VggtMotionError]] = {}
        self._interrupted = threading.Event()
        self.is_closed = False

    @property
    def is_connected(self) -> bool:
        """Whether there is a link to a router at this moment."""
        return not self.is_closed and bool(self._session.info.routers_zid())

    @property
    def is_interrupted(self) -> bool:
        """Whether requests have been ended by :meth:`interrupt` or :meth:`close`."""
        return self._interrupted.is_set()

    def request(
        self,
        key: str,
        payload: Payload,
        *,
        timeout_s: float | None = None,
        encoding: str = "",
        is_long_poll: bool = False,
    ) -> bytes:
        """An acknowledged call: send a query and wait for its one answer.

        Args:
            key: who is asked for what.
            payload: the request.
            timeout_s: None = as the configuration says.
            encoding: of the payload, where it is not the usual one.
            is_long_poll: the answer may be seconds away: waiting for it costs nothing, its arrival a little more.

        Raises:
            BusUnavailableError: nobody answered, the link is down, or requests were interrupted; may be repeated.
            RequestRefusedError: the other side refused; ``code`` says why.
            DiskFullError: the other side has no space.
            BusError: the message is longer than the bus carries.
        """
        if len(payload) > MAX_PAYLOAD_BYTES:
            raise BusError(f"{key}: a request of {len(payload)} bytes is longer than the bus carries")
        timeout = self.config.request_timeout_s if timeout_s is None else timeout_s
        parcels = self._parcels if time.monotonic() >= self._messages_until_s else _NO_PARCELS
        parcel = parcels.leave(payload) if key in self._near_keys else None
        is_by_parcel = parcel is not None
        is_answered = False
        answer = WokenAnswer() if is_long_poll else PolledAnswer()
        try:
            if parcel is None:
                sample = self._ask(key, joined(payload), parcels.greeting, timeout, encoding, answer)
            else:
                sample = self._ask(key, b"", parcel.attachment, timeout, encoding, answer)
            is_answered = True
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            if payload and self._parcels.is_near(attachment):
                self._near_keys.add(key)
            is_by_parcel |= self._parcels.size_bytes(attachment) > 0
            return self._parcels.take(sample.payload.to_bytes(), attachment, is_last_reader=True)
        except BusUnavailableError:
            if is_by_parcel:
                # Whatever the reason was: the next attempts go without, and so does what answers them.
                self._messages_until_s = time.monotonic() + _MESSAGES_ONLY_S
            raise
        finally:
            if parcel is not None:
                parcels.take_back(parcel, is_read=is_answered)

    def request_among_others(self, key: str, payload: Payload) -> bytes:
        """As :meth:`request`, of a key that is served by :meth:`serve_together`.

        What comes while other requests to the key are under way travels with them in one message.
        """
        if len(payload) > _BUNDLED_BYTES:
            return self.request(key, payload)
        with self._lock:
            gathering = self._gatherings.get(key)
            if gathering is None:
                carry_out = functools.partial(self._request_bundle, key)
                gathering = self._gatherings[key] = Gathering(
                    carry_out,
                    lanes=_BUNDLES_UNDER_WAY,
                    max_weight=lambda: self._bundle_bytes,
                    weigh=_weight_in_bundle,
                )
        outcome = gathering(payload)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def request_all(self, key: str, payloads: Sequence[Payload]) -> list[bytes | VggtMotionError]:
        """Several requests to a key that is served by :meth:`serve_together`, in order, in one message.

        Returns:
            For the first of them, at least one, the answer or why it was refused: the others are to be asked next.

        Raises:
            BusUnavailableError: nobody answered; may be repeated, and is then of fewer requests.
        """
        bundle: list[Payload] = []
        weight = 0
        for payload in payloads:
            weight += _weight_in_bundle(payload)
            if bundle and weight > self._bundle_bytes:
                break
            bundle.append(payload)
        outcomes = self._request_bundle(key, bundle)
        for index, outcome in enumerate(outcomes):
            if isinstance(outcome, BusUnavailableError):
                if index == 0:
                    raise outcome
                return outcomes[:index]
        return outcomes

    def _request_bundle(self, key: str, payloads: Sequence[Payload]) -> list[bytes | VggtMotionError]:
        try:
            outcomes = self._answers_to(key, payloads)
        except BusUnavailableError:
            # A slow link may carry a few of them in time where it does not carry all.
            self._bundle_bytes = max(self._bundle_bytes // 2, _MIN_BUNDLE_BYTES)
            raise
        self._bundle_bytes = min(self._bundle_bytes * 2, _MAX_BUNDLE_BYTES)
        return outcomes

    def _answers_to(self, key: str, payloads: Sequence[Payload]) -> list[bytes | VggtMotionError]:
        if len(payloads) == 1:
            try:
                return [self.request(key, payloads[0])]
            except BusUnavailableError:
                raise
            except VggtMotionError as error:
                return [error]
        bundle = codec.encode_in_pieces(calls.Bundle(tuple(payloads)))
        reply = codec.decode(calls.BundleReply, self.request(key, bundle, encoding=BUNDLE_ENCODING))
        if len(reply.answers) != len(payloads):
            raise CodecError(f"{key}: {len(reply.answers)} answers to {len(payloads)} requests")
        return [answer.payload if answer.refusal is None else error_of(answer.refusal) for answer in reply.answers]

    def _ask(
        self,
        key: str,
        payload: bytes,
        attachment: bytes | None,
        timeout: float,
        encoding: str,
        answer: WokenAnswer | PolledAnswer,
    ) -> zenoh.Sample:
        """Send a query and wait for its one answer."""
        if self._interrupted.is_set():
            raise BusUnavailableError(f"{key}: stopping")
        try:
            channel: Any = self._session.get(
                key,
                answer.handler,
                payload=payload,
                encoding=encoding or None,
                attachment=attachment,
                timeout=timeout,
                congestion_control=zenoh.CongestionControl.BLOCK,
                consolidation=zenoh.ConsolidationMode.NONE,
                cancellation_token=self._requests,
            )
            reply = answer.wait(channel)
        except zenoh.ZError:
            # What closes without a reply: nobody serves the key, or whoever did has gone.
            if self._interrupted.is_set():
                raise BusUnavailableError(f"{key}: stopping") from None
            raise BusUnavailableError(f"{key}: nobody answers") from None
        if reply.ok is not None:
            sample: zenoh.Sample = reply.ok
            return sample
        error = reply.err
        assert error is not None  # one of the two
        if str(error.encoding) != REFUSAL_ENCODING:  # Zenoh's own, such as a timeout
            raise BusUnavailableError(f"{key}: no answer within {timeout:g} s ({error.payload.to_bytes()[:80]!r})")
        try:
            refusal = codec.decode(calls.Refusal, error.payload.to_bytes())
        except CodecError as problem:
            raise BusUnavailableError(f"{key}: an answer that cannot be read: {problem}") from None
        raise error_of(refusal)

    def serve(self, key: str, handler: Handler, *, threads: int = 1) -> Closable:
        """Answer requests on a key.

        ``handler(key of the request, payload)`` runs in up to ``threads`` threads of ours and may block; a
        VggtMotionError that it raises becomes an error reply. Waiting requests are bounded; beyond that they are
        refused as unavailable.
        """
        return self._keep(SleepingServer(self._session, key, handler, self._parcels, threads=threads, at_a_time=None))

    def serve_together(
        self,
        key: str,
        handler: BatchHandler,
        *,
        at_a_time: int,
        threads: int = 1,
        after: Callable[[], None] | None = None,
    ) -> Closable:
        """As :meth:`serve`, of up to ``at_a_time`` messages that came while others were being answered, and promptly.

        ``handler(payloads)`` returns for each, in order, its answer or the exception that becomes its error reply;
        ``after`` is called when they have been sent.
        """
        return self._keep(
            PromptServer(self._session, key, handler, self._parcels, threads=threads, at_a_time=at_a_time, after=after)
        )

    def publisher(self, key: str, *, blocking: bool, history: int = 0, encoding: str = "") -> Publisher:
        """A publisher on a key.

        Args:
            key: concrete key.
            blocking: wait for slow subscribers instead of dropping: for file images and the log only.
            history: so many messages are kept for late and recovering subscribers, at most ``pubsub.MAX_HISTORY``.
            encoding: from ``codec.encoding_of``.
        """
        return self._keep(Publisher(self._session, key, blocking=blocking, history=history, encoding=encoding))

    def subscribe(
        self,
        key: str,
        callback: Callable[[Sample], None],
        *,
        latest_only: bool = False,
        history: bool = False,
        isolated: bool = False,
        is_small: bool = False,
    ) -> Closable:
        """Deliver the samples of a key to ``callback``, in a thread of ours.

        Args:
            key: may hold wildcards.
            callback: must not stay away long unless ``latest_only`` or ``isolated``: a subscription that is not drained
                holds up everything on its link, the answers to this process's own requests included.
            latest_only: old samples are dropped in favour of the newest: for live views.
            history: first what the publishers keep, and recover what a broken link lost; needs ``history`` there too.
            isolated: over a link of its own, where a slow callback slows down nothing but a blocking publisher.
            is_small: messages of some kilobytes, of which hundreds may wait; costs less. Without the other options.
        """
        if not isolated:
            return self._keep(
                Subscription(self._session, key, callback, latest_only=latest_only, history=history, is_small=is_small)
            )
        own = open_bus(self.config)
        own.subscribe(key, callback, latest_only=latest_only, history=history)
        return self._keep(own)

    def watch_liveliness(self, key: str, callback: Callable[[str, bool], None]) -> Closable:
        """Tell ``callback(key, is alive)`` of every liveliness token, present ones first."""
        return self._keep(LivelinessSubscription(self._session, key, callback))

    def declare_token(self, key: str) -> Closable:
        """Declare a liveliness token."""
        return self._keep(Token(self._session, key))

    def interrupt(self) -> None:
        """End all requests under way and refuse new ones, so that a process that was told to stop does not wait."""
        self._interrupted.set()
        with contextlib.suppress(zenoh.ZError):
            self._requests.cancel()  # type: ignore[no-untyped-call]

    def wait(self, timeout_s: float) -> bool:
        """Sleep between attempts; True as soon as requests are interrupted."""
        return self._interrupted.wait(timeout_s)

    def close(self) -> None:
        """End everything declared here, flush, and leave; a link that does not flush is abandoned after a second."""
        with self._lock:
            if self.is_closed:
                return
            self.is_closed = True
            closables = list(reversed(self._closables))
            self._closables.clear()
        self.interrupt()

        def leave() -> None:
            # All at once, then one short wait for all: handlers that do not end must not eat the time for the flush.
            servers = [closable for closable in closables if isinstance(closable, Server)]
            for server in servers:
                server.begin_close()
            deadline = time.monotonic() + _HANDLERS_S
            for server in servers:
                server.close(max(0.0, deadline - time.monotonic()))
            for closable in closables:
                if not isinstance(closable, Server):
                    closable.close()
            self._parcels.close()
            self._session.close()  # type: ignore[no-untyped-call]

        thread = threading.Thread(target=leave, name="leave the bus", daemon=True)
        thread.start()
        thread.join(_CLOSE_S)
        if thread.is_alive():
            _log.warning("the link does not flush and is abandoned", extra={"endpoint": self.config.endpoint})

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _keep(self, closable: Kept) -> Kept:
        with self._lock:
            if self.is_closed:
                raise BusUnavailableError("the bus is closed")
            self._closables = [entry for entry in self._closables if not entry.is_closed]
            self._closables.append(closable)
        return closable


def _weight_in_bundle(payload: Payload) -> int:
    return max(len(payload), _MIN_BUNDLE_BYTES)


def _reason(error: Exception) -> str:
    # Zenoh appends the place in its source to every message.
    return " ".join(str(error).split()).split(" at /")[0]
