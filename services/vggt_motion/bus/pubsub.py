"""Publishing and subscribing: one thread drains each subscription, so that no channel ever fills up by neglect."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from datetime import timedelta
from typing import Any, Protocol

import zenoh
from zenoh import ext, handlers

from vggt_motion.bus.delivery import Calls
from vggt_motion.errors import BusError, BusUnavailableError

_log = logging.getLogger(__name__)
_FIFO_CAPACITY = 8  # the default of 256 messages would be a gigabyte of images
# With history, replies come in while the subscriber is still being declared and nobody can read yet. If they do not
# fit, the declaration never returns (seen under load: 64 messages of history against a channel of 8), and a blocking
# publisher stands still with it. So what a publisher keeps must fit, with room for what is published meanwhile.
MAX_HISTORY = 64
_HISTORY_FIFO_CAPACITY = 4 * MAX_HISTORY
_LATEST_CAPACITY = 1
# Recovery asks the publishers; their heartbeats alone bring nothing back after a restart of the router (Zenoh 1.10).
_RECOVERY_INTERVAL = timedelta(seconds=1)
_JOIN_S = 0.3
_NS_PER_S = 1_000_000_000
MAX_PAYLOAD_BYTES = 768 * 2**20  # Zenoh drops what exceeds 1 GiB without a word


class Closable(Protocol):
    """Something that is at work until it is closed; closing twice does nothing."""

    is_closed: bool

    def close(self) -> None:
        """End it."""


class Sample:
    """One received message; what is not asked for is not taken out of it."""

    __slots__ = ("_received", "key")

    def __init__(self, received: zenoh.Sample) -> None:
        """Wrap what Zenoh delivered."""
        self._received = received
        self.key = str(received.key_expr)

    @property
    def payload(self) -> bytes:
        """The message, copied each time it is asked for."""
        return self._received.payload.to_bytes()

    @property
    def timestamp_ns(self) -> int | None:
        """Unix time given by the publisher, else by the router; to about a nanosecond."""
        timestamp = self._received.timestamp
        if timestamp is None:
            return None
        time = timestamp.get_time_as_ntp64()
        return int(time.as_secs() * _NS_PER_S + time.subsec_nanos())

    @property
    def attachment(self) -> bytes:
        """What travels beside the message."""
        attachment = self._received.attachment
        return b"" if attachment is None else attachment.to_bytes()

    @property
    def encoding(self) -> str:
        """What the message is, as its publisher says."""
        return str(self._received.encoding)


class Publisher:
    """Publishes on one key. Thread-safe."""

    def __init__(self, session: zenoh.Session, key: str, *, blocking: bool, history: int, encoding: str) -> None:
        if history > MAX_HISTORY:
            raise ValueError(f"{key}: a history of {history} messages is longer than {MAX_HISTORY}")
        congestion = zenoh.CongestionControl.BLOCK if blocking else zenoh.CongestionControl.DROP
        self.is_closed = False
        self._key = key
        self._timestamp_id = _timestamp_id(session)
        self._publisher: Any
        if history > 0:
            self._publisher = ext.declare_advanced_publisher(
                session,
                key,
                encoding=encoding or None,
                congestion_control=congestion,
                reliability=zenoh.Reliability.RELIABLE,
                cache=ext.CacheConfig(history),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        else:
            self._publisher = session.declare_publisher(
                key,
                encoding=encoding or None,
                congestion_control=congestion,
                reliability=zenoh.Reliability.RELIABLE,
            )

    def put(
        self, payload: bytes, *, timestamp_ns: int | None = None, attachment: bytes = b"", encoding: str = ""
    ) -> None:
        """Publish.

        Args:
            payload: the message.
            timestamp_ns: Unix time to travel with it; None lets the router put its own.
            attachment: small bytes beside the payload.
            encoding: in place of the publisher's own.

        Raises:
            BusUnavailableError: the session is closed.
            BusError: the message is longer than the bus carries.
        """
        if len(payload) > MAX_PAYLOAD_BYTES:
            raise BusError(f"{self._key}: a message of {len(payload)} bytes is longer than the bus carries")
        timestamp = None
        if timestamp_ns is not None:
            seconds, nanoseconds = divmod(timestamp_ns, _NS_PER_S)
            timestamp = zenoh.Timestamp(zenoh.NTP64(seconds, nanoseconds), self._timestamp_id)
        try:
            options = {"encoding": encoding} if encoding else {}
            self._publisher.put(payload, attachment=attachment or None, timestamp=timestamp, **options)
        except zenoh.ZError as error:
            raise BusUnavailableError(f"{self._key}: cannot publish: {_one_line(error)}") from None

    def close(self) -> None:
        """Undeclare; a cache of history goes with it."""
        self.is_closed = True
        _undeclare(self._publisher)


class Subscription:
    """Delivers samples of a key to a callback, in a thread of ours."""

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        callback: Callable[[Sample], None],
        *,
        latest_only: bool,
        history: bool,
        is_small: bool,
    ) -> None:
        self._callback = callback
        self._key = key
        self.is_closed = False
        self._subscriber: Any
        self._calls: Calls | None = None
        if is_small:
            self._calls = Calls(self._take)
            self._subscriber = self._calls.declare(lambda handler: session.declare_subscriber(key, handler))
            return
        capacity = _HISTORY_FIFO_CAPACITY if history else _FIFO_CAPACITY
        channel: Any = handlers.RingChannel(_LATEST_CAPACITY) if latest_only else handlers.FifoChannel(capacity)
        if history:
            self._subscriber = ext.declare_advanced_subscriber(
                session,
                key,
                channel,
                history=ext.HistoryConfig(detect_late_publishers=True),
                # The stub says float, the implementation wants a timedelta.
                recovery=ext.RecoveryConfig(periodic_queries=_RECOVERY_INTERVAL, heartbeat=None),  # type: ignore[arg-type]
            )
        else:
            self._subscriber = session.declare_subscriber(key, channel)
        # The handler on its own: undeclaring a subscriber while a thread waits in it is refused as borrowed.
        self._handler = self._subscriber.handler
        self._thread = threading.Thread(target=self._drain, name=f"drain {key}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Undeclare and wait for the callback that may be under way, if not called from it."""
        self.is_closed = True
        _undeclare(self._subscriber)
        if self._calls is not None:
            self._calls.wait_for_end()
        elif threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)

    def _drain(self) -> None:
        while True:
            try:
                received = self._handler.recv()
            except zenoh.ZError:
                return  # undeclared, or the session was closed
            self._take(received)

    def _take(self, received: zenoh.Sample) -> None:
        # Taken to the end also when we are closed: a full channel that nobody reads blocks a thread of Zenoh's for
        # good, and with it the next session that this process opens.
        if self.is_closed or received.kind != zenoh.SampleKind.PUT:
            return
        try:
            self._callback(Sample(received))
        except Exception:
            _log.exception("a subscriber's callback failed; the message is passed over", extra={"key": self._key})


class LivelinessSubscription:
    """Tells a callback which liveliness tokens of a key appear and disappear, those that are there already included."""

    def __init__(self, session: zenoh.Session, key: str, callback: Callable[[str, bool], None]) -> None:
        self.is_closed = False
        self._callback = callback
        self._calls = Calls(self._take)
        self._subscriber = self._calls.declare(
            lambda handler: session.liveliness().declare_subscriber(key, handler, history=True)
        )

    def close(self) -> None:
        """Undeclare."""
        self.is_closed = True
        _undeclare(self._subscriber)
        self._calls.wait_for_end()

    def _take(self, received: zenoh.Sample) -> None:
        try:
            self._callback(str(received.key_expr), received.kind == zenoh.SampleKind.PUT)
        except Exception:
            _log.exception("a liveliness callback failed", extra={"key": str(received.key_expr)})


class Token:
    """A liveliness token: there as long as this process and its link are."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.is_closed = False
        self._token: Any = session.liveliness().declare_token(key)

    def close(self) -> None:
        """Take it back."""
        self.is_closed = True
        _undeclare(self._token)


def _timestamp_id(session: zenoh.Session) -> zenoh.TimestampId:
    return session.new_timestamp().get_id()


def _undeclare(entity: Any) -> None:
    try:
        entity.undeclare()
    except (zenoh.ZError, RuntimeError):
        return  # undeclared before, or its session is closed


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
