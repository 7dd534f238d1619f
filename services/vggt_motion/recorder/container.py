"""Reading MCAP files front to back, whole or broken off: what repair, the MCAP source and replay stand on.

The reader of the ``mcap`` package needs the summary at the end of the file, and its stream reader takes a short read
for a whole record. A recording whose process was killed has neither an end nor a guarantee on its last record. So the
framing is checked here, record by record: a record counts only if every byte of it is there, and a chunk only if its
checksum holds. Everything before the first damage is delivered; nothing after it is guessed at.

Format: https://mcap.dev/spec (records are opcode, length, content; messages sit in chunks).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from vggt_motion.errors import SourceError

MAGIC = b"\x89MCAP0\r\n"
_PREFIX = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD_BYTES = 22  # channel, sequence, log time, publish time
# Our chunks hold some megabytes; a length beyond this is damage or an attack, and must not become an allocation.
MAX_RECORD_BYTES = 2**30


@dataclass(frozen=True)
class StoredChannel:
    """A channel of a file with its schema."""

    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes = field(repr=False)
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Location:
    """Where a message lies: its outermost record in the file, and the message record inside it when that is a chunk."""

    record_offset: int
    offset_in_chunk: int | None


@dataclass(frozen=True)
class StoredMessage:
    """One message of a file."""

    channel: StoredChannel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes = field(repr=False)
    location: Location


class _DamageError(Exception):
    """The record at hand is not whole; its text says why."""


class McapScanner:
    """Reads one file from its beginning.

    Attributes:
        damage: after the scan: None when the file is whole, else one line that says where it breaks off and how.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            SourceError: it cannot be read, or is no MCAP file.
        """
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
        try:
            magic = self._file.read(len(MAGIC))
            self._size = path.stat().st_size
        except OSError as error:
            self._file.close()
            raise SourceError(f"cannot read {path}: {error.strerror or error}") from error
        if magic != MAGIC:
            self._file.close()
            raise SourceError(f"{path} is not an MCAP file")
        self.path = path
        self.damage: str | None = None
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, StoredChannel] = {}
        self._cached_chunk: tuple[int, bytes] = (-1, b"")

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    def messages(self) -> Iterator[StoredMessage]:
        """All messages in file order, up to the end or to the first damage, which ``damage`` then tells."""
        self.damage = None
        self._schemas.clear()
        self._channels.clear()
        offset = len(MAGIC)
        is_data_ended = False
        while True:
            try:
                if self._size == offset:
                    raise _DamageError("the file ends without a footer")
                opcode, length = self._read_prefix(offset)
                if is_data_ended and opcode != Opcode.FOOTER:
                    # The summary repeats what is known by now.
                    if offset + _PREFIX.size + length > self._size:
                        raise _DamageError("a record of the summary is cut off")
                    content: list[StoredMessage] = []
                else:
                    content = self._read_record(offset, opcode, length)
            except _DamageError as damage:
                self.damage = f"{damage} (at byte {offset} of {self._size})"
                return
            yield from content
            offset += _PREFIX.size + length
            if opcode == Opcode.DATA_END:
                is_data_ended = True
            elif opcode == Opcode.FOOTER:
                if self._read_at(offset, len(MAGIC)) != MAGIC:
                    self.damage = f"the closing mark is missing (at byte {offset} of {self._size})"
                return

    def data_at(self, location: Location) -> bytes:
        """The content of a message that a scan has found before.

        Raises:
            SourceError: the file changed under us.
        """
        try:
            if location.offset_in_chunk is None:
                return _message_data(self._body(location.record_offset))
            chunk_offset, chunk = self._cached_chunk
            if chunk_offset != location.record_offset:
                chunk = _decompressed(self._body(location.record_offset))
                # One chunk is kept: frames are asked for in order.
                self._cached_chunk = (location.record_offset, chunk)
            _, length = _PREFIX.unpack_from(chunk, location.offset_in_chunk)
            start = location.offset_in_chunk + _PREFIX.size
            return _message_data(chunk[start : start + length])
        except (_DamageError, struct.error) as error:
            raise SourceError(f"{self.path} changed while it was read: {error}") from error

    def _read_prefix(self, offset: int) -> tuple[int, int]:
        prefix = self._read_at(offset, _PREFIX.size)
        if len(prefix) < _PREFIX.size:
            raise _DamageError("a record is cut off")
        opcode, length = _PREFIX.unpack(prefix)
        if opcode == 0:
            raise _DamageError("a record has the opcode 0")
        return opcode, length

    def _body(self, offset: int) -> bytes:
        _, length = self._read_prefix(offset)
        if offset + _PREFIX.size + length > self._size:
            raise _DamageError("a record is cut off")
        if length > MAX_RECORD_BYTES:
            raise _DamageError(f"a record claims {length} bytes")
        body = self._file.read(length)
        if len(body) < length:
            raise _DamageError("a record is cut off")
        return body

    def _read_at(self, offset: int, length: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(length)

    def _read_record(self, offset: int, opcode: int, length: int) -> list[StoredMessage]:
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
            if offset + _PREFIX.size + length > self._size:
                raise _DamageError("a record is cut off")
            return []
        body = self._body(offset)
        if opcode == Opcode.CHUNK:
            return self._read_chunk(offset, _decompressed(body))
        message = self._read_inner(opcode, body, Location(offset, None))
        return [] if message is None else [message]

    def _read_chunk(self, chunk_offset: int, content: bytes) -> list[StoredMessage]:
        found = []
        position = 0
        while position < len(content):
            if position + _PREFIX.size > len(content):
                raise _DamageError("a record in a chunk is cut off")
            opcode, length = _PREFIX.unpack_from(content, position)
            start = position + _PREFIX.size
            if start + length > len(content):
                raise _DamageError("a record in a chunk is cut off")
            message = self._read_inner(opcode, content[start : start + length], Location(chunk_offset, position))
            if message is not None:
                found.append(message)
            position = start + length
        self._cached_chunk = (chunk_offset, content)
        return found

    def _read_inner(self, opcode: int, body: bytes, location: Location) -> StoredMessage | None:
        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._add_channel(Channel.read(stream))
            elif opcode == Opcode.MESSAGE:
                if len(body) < _MESSAGE_HEAD_BYTES:
                    raise _DamageError("a message is too short")
                message = Message.read(stream, len(body))
                if message.channel_id not in self._channels:
                    raise _DamageError(f"a message names channel {message.channel_id}, which the file does not define")
                return StoredMessage(
                    self._channels[message.channel_id],
                    message.sequence,
                    message.log_time,
                    message.publish_time,
                    message.data,
                    location,
                )
        except _DamageError:
            raise
        except Exception as error:  # the record parsers raise struct.error, UnicodeDecodeError, EndOfFile, ...
            raise _DamageError(f"a {Opcode(opcode).name.lower()} record is malformed") from error
        return None

    def _add_channel(self, channel: Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        if schema is None and channel.schema_id != 0:
            raise _DamageError(
                f"channel {channel.topic!r} names schema {channel.schema_id}, which the file does not define"
            )
        self._channels[channel.id] = StoredChannel(
            channel.topic,
            channel.message_encoding,
            schema.name if schema else "",
            schema.encoding if schema else "",
            schema.data if schema else b"",
            channel.metadata,
        )


def _message_data(body: bytes) -> bytes:
    if len(body) < _MESSAGE_HEAD_BYTES:
        raise _DamageError("a message is too short")
    return body[_MESSAGE_HEAD_BYTES:]


def _decompressed(body: bytes) -> bytes:
    """Content of a chunk record, its size and checksum verified before anything in it is believed."""
    if len(body) < _CHUNK_HEAD.size:
        raise _DamageError("a chunk is cut off")
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    except Exception as error:
        raise _DamageError("a chunk record is malformed") from error
    if chunk.uncompressed_size > MAX_RECORD_BYTES:
        raise _DamageError(f"a chunk claims {chunk.uncompressed_size} bytes")
    if chunk.compression == "zstd":
        content = _unzstd(chunk.data, chunk.uncompressed_size)
    elif chunk.compression == "":
        content = chunk.data
    else:
        raise _DamageError(f"chunks are compressed with {chunk.compression}, only zstd is read")
    if len(content) != chunk.uncompressed_size:
        raise _DamageError("a chunk has not the size that it claims")
    if chunk.uncompressed_crc != 0 and zlib.crc32(content) != chunk.uncompressed_crc:
        raise _DamageError("the checksum of a chunk does not hold")
    return content


def _unzstd(data: bytes, size: int) -> bytes:
    try:
        declared = zstandard.frame_content_size(data)
        # The decompressor allocates what the frame declares, whatever limit it is given.
        if declared > size:
            raise _DamageError("a chunk has not the size that it claims")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""
    except zstandard.ZstdError as error:
        raise _DamageError("a chunk cannot be decompressed") from error
