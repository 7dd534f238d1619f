"""All streams of the log at once, for those who fold it: backend, gateway, recorder, ``run``."""

from __future__ import annotations

from vggt_motion.bus.follow import Follower
from vggt_motion.bus.session import Bus
from vggt_motion.records import Constraint, Event, GraphUpdate, Keyframe, Segment, Stream, SubmapGeometry

LogRecord = Keyframe | Segment | SubmapGeometry | Constraint | GraphUpdate | Event

RECORD_OF_STREAM: dict[Stream, type[LogRecord]] = {
    Stream.KEYFRAME: Keyframe,
    Stream.SEGMENT: Segment,
    Stream.SUBMAP: SubmapGeometry,
    Stream.CONSTRAINT: Constraint,
    Stream.GRAPH: GraphUpdate,
    Stream.EVENT: Event,
}


class LogFollower:
    """Follows every stream from its beginning; records of one stream come in order, the streams are independent."""

    def __init__(self, bus: Bus) -> None:
        """Start to follow."""
        self._followers = {stream: Follower(bus, stream, cls) for stream, cls in RECORD_OF_STREAM.items()}
        self._positions = dict.fromkeys(RECORD_OF_STREAM, 0)

    def poll(self) -> list[LogRecord]:
        """What is new since the last call; does not wait."""
        records: list[LogRecord] = []
        for stream, follower in self._followers.items():
            while (followed := follower.next(0.0)) is not None:
                records.append(followed.record)
                self._positions[stream] = followed.sequence + 1
        return records

    def positions(self) -> dict[Stream, int]:
        """How many records of each stream were delivered."""
        return dict(self._positions)

    def close(self) -> None:
        """Stop following."""
        for follower in self._followers.values():
            follower.close()
