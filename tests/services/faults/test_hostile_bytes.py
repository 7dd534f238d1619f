"""Hostile bytes on every entry: one clear refusal, and nothing else changes."""

from __future__ import annotations

import contextlib
import os
import random
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ledger_helpers import stored_blobs
from live_session import live_session, wait_for
from synthetic_session import Session
from vggt_motion.bus import calls, codec
from vggt_motion.bus.images import ImageHeader, decode_image, encode_image
from vggt_motion.bus.ledger import append_request
from vggt_motion.bus.parcels import _identity
from vggt_motion.bus.serving import BUNDLE_ENCODING
from vggt_motion.bus.session import Bus
from vggt_motion.errors import CodecError, RequestRefusedError
from vggt_motion.ledger.admission import admitted
from vggt_motion.records import HealthReport, JobKind, Stream
from vggt_motion.sources.registry import open_source
from vggt_motion.sources.source import Frame

pytestmark = [pytest.mark.faults, pytest.mark.timeout(1800)]
CASES = 20_000
LIVE_CASES = 200
SESSION = Session(2)


def _appends() -> list[calls.AppendRequest]:
    found = []
    for stream, _, record in SESSION.entries():
        blobs = [SESSION.blobs[ref.sha256] for ref in codec.blob_refs(record)]
        record_id = next(
            str(getattr(record, n)) for n in ("record_id", "keyframe_id", "event_id") if hasattr(record, n)
        )
        found.append(append_request(stream, record_id, record, blobs))  # type: ignore[arg-type]
    return found


APPENDS = _appends()
RESULTS = [request for request in APPENDS if request.stream in (Stream.SUBMAP.value, Stream.CONSTRAINT.value)]
PICTURE = bytes(cv2.imencode(".jpg", np.zeros((20, 32), np.uint8))[1])
DEPTHS = [blob for request in RESULTS for blob in request.blobs]


def _append_entry(payload: bytes) -> None:
    admitted(codec.decode(calls.AppendRequest, payload))


def _long_append_entry(payload: bytes) -> None:
    """As the blobs of a long request are read: as views."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "LIFTED_FROM_BYTES", 0)
        _append_entry(payload)


def _done_entry(payload: bytes) -> None:
    admitted(codec.decode(calls.DoneRequest, payload).result)


def _bundle_entry(payload: bytes) -> None:
    for request in codec.decode(calls.Bundle, payload).requests:
        assert isinstance(request, (bytes, memoryview))
        with contextlib.suppress(CodecError, RequestRefusedError):  # each for itself
            _append_entry(bytes(request))


ENTRIES: dict[str, tuple[Callable[[bytes], Any], list[bytes]]] = {
    "append": (_append_entry, [codec.encode(request) for request in APPENDS]),
    "done": (_done_entry, [codec.encode(calls.DoneRequest("job", "lease", request)) for request in RESULTS]),
    "long append": (_long_append_entry, [codec.encode(request) for request in APPENDS]),
    "bundle": (
        _bundle_entry,
        [codec.encode(calls.Bundle(tuple(map(codec.encode, APPENDS[at:])))) for at in (0, 3, -1)],
    ),
    "parcel": (
        lambda payload: codec.decode(calls.Parcel, payload),
        [codec.encode(calls.Parcel("0123456789abcdef" * 2, "0123456789abcdef-7", 100_000))],
    ),
    "claim": (
        lambda payload: codec.decode(calls.ClaimRequest, payload),
        [codec.encode(calls.ClaimRequest((JobKind.PREDICT,), ("sfm",), "inference/1", 0.0, "claim"))],
    ),
    "image": (
        lambda payload: decode_image(payload, ImageHeader(0, 1).encode()),
        [encode_image(Frame(0, 1, PICTURE, "image/jpeg"), "front")],
    ),
    "image header": (
        lambda payload: decode_image(ENTRIES["image"][1][0], payload),
        [ImageHeader(3, 1000).encode()],
    ),
    "depth": (codec.decode_depth, DEPTHS),
}


@st.composite
def hostile(draw: st.DrawFn, good: list[bytes]) -> bytes:
    """A good message with a few things done to it, or no message at all."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=300))
    payload = bytearray(draw(st.sampled_from(good)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(payload)))
        match draw(st.integers(0, 5)):
            case 0 if payload:
                payload[at % len(payload)] = draw(st.integers(0, 255))
            case 1:
                del payload[at:]
            case 2:
                payload[at:at] = draw(st.binary(max_size=20))
            case 3:  # the same field twice, or a message in a message
                payload[at:at] = payload[: draw(st.integers(0, 200))]
            case 4:  # a number that is none, or too large
                number = draw(st.sampled_from([float("nan"), float("inf"), -1e300, 1e300]))
                payload[at : at + 8] = struct.pack("<d", number)
            case _:  # lengths and counts beyond everything
                payload[at : at + 5] = b"\xff\xff\xff\xff\x0f"
    return bytes(payload)


@pytest.mark.parametrize("entry", ENTRIES)
def test_whatever_comes_is_taken_or_refused(entry: str) -> None:
    decode, good = ENTRIES[entry]
    for payload in good:
        decode(payload)

    @settings(
        max_examples=CASES,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(hostile(good))
    def attack(payload: bytes) -> None:
        try:
            decode(payload)
        except (CodecError, RequestRefusedError) as error:
            text = str(error)
            assert text and "\n" not in text and len(text) < 2000

    attack()


def _bomb() -> bytes:
    """Depth that unpacks to a gigabyte."""
    return zstandard.ZstdCompressor(level=19).compress(bytes(2**30))


def _cases(entry: str, generator: random.Random) -> list[bytes]:
    """Messages that are not what they may be."""
    good = ENTRIES[entry][1]
    cases = [*(generator.randbytes(size) for size in (1, 10, 1000, 3_000_000))]
    while len(cases) < LIVE_CASES:
        payload = bytearray(generator.choice(good))
        match generator.randrange(4):
            case 0:
                payload = payload[: generator.randrange(1, len(payload))]
            case 1:
                payload[generator.randrange(len(payload))] ^= 1 << generator.randrange(8)
            case 2:
                payload += generator.randbytes(50)
            case 3:
                payload[0:0] = b"\x08\x63"  # schema_version = 99
        if not _is_sound(entry, bytes(payload)):
            cases.append(bytes(payload))
    return cases


def test_hostile_bytes_through_a_live_session(tmp_path: Path, sample_dir: Path, generator: random.Random) -> None:
    images = list(open_source(str(sample_dir / "kitti_06_first51"), end=20).frames())
    spool = {"spool": {"directory": str(tmp_path / "spool")}}
    with live_session(tmp_path, **spool) as session:
        frontend = session.start("frontend", "--source", "zenoh:front")
        camera = session.bus.publisher(session.bus.keys.image("front"), blocking=True, history=8)
        wait_for(lambda: session.ledger.read(Stream.EVENT, 0, patience_s=30.0), "the frontend's first record")
        for frame in images[:10]:
            camera.put(encode_image(frame, "front"), attachment=ImageHeader(0, frame.index).encode())
        wait_for(lambda: session.ledger.status().position("keyframe") > 1, "keyframes")
        time.sleep(1.0)
        before, stored = session.ledger.status(), stored_blobs(tmp_path / "ledger")
        # Valid in form, but not in content: a bomb, a wrong shape, no number, an unknown stream.
        submap = SESSION.submaps[0]
        bomb = codec.blob_ref(_bomb(), codec.DEPTH_MEDIA_TYPE)
        bombed = replace(submap, frames=(replace(submap.frames[0], depth=bomb),))
        not_a_number = submap.frames[0].submap_from_camera.copy()
        not_a_number[0, 3] = np.nan
        shaped = replace(submap.frames[0], intrinsics=replace(submap.frames[0].intrinsics, width_px=31))
        wrong = [codec.encode(append_request(Stream.SUBMAP, bombed.record_id, bombed, [_bomb()]))]
        for bad in (replace(submap, frames=(shaped,)),):
            blobs = [SESSION.blobs[ref.sha256] for ref in codec.blob_refs(bad)]
            wrong.append(codec.encode(append_request(Stream.SUBMAP, bad.record_id, bad, blobs)))
        with pytest.raises(CodecError):
            codec.encode(replace(submap, frames=(replace(submap.frames[0], submap_from_camera=not_a_number),)))
        wrong.append(codec.encode(replace(APPENDS[0], stream="nonsense")))
        refused = 0
        keys = session.bus.keys
        for service, call, entry in (
            ("ledger", "append", "append"),
            ("jobs", "claim", "claim"),
            ("jobs", "done", "done"),
        ):
            cases = _cases(entry, generator) + (wrong if call == "append" else [])
            for payload in cases:
                with pytest.raises(RequestRefusedError) as caught:
                    session.bus.request(keys.rpc(service, call), payload)
                assert "\n" not in str(caught.value)
                refused += 1
        assert refused >= 3 * LIVE_CASES
        for payload in _cases("bundle", generator):
            with pytest.raises(RequestRefusedError):
                session.bus.request(keys.rpc("ledger", "append"), payload, encoding=BUNDLE_ENCODING)
            refused += 1
        bundle = codec.encode(calls.Bundle(tuple(wrong)))
        reply = session.bus.request(keys.rpc("ledger", "append"), bundle, encoding=BUNDLE_ENCODING)
        answers = codec.decode(calls.BundleReply, reply).answers
        assert len(answers) == len(wrong) and all(answer.refusal is not None for answer in answers)
        refused += len(wrong)
        with _foreign_parcels(session.bus, tmp_path) as foreign:
            for attachment in (*_cases("parcel", generator), *foreign):
                asked: Any = session.bus._session.get(
                    keys.rpc("ledger", "append"), payload=b"", attachment=attachment, timeout=10.0
                )
                assert asked.recv().err is not None
        cases = _cases("image", generator)
        for payload in cases:
            camera.put(payload, attachment=generator.choice([b"", b"\xff" * 9, ImageHeader(0, 11).encode()]))
        status = wait_for(lambda: _settled(session, before.refused_request_count + refused), "the refusals' count")
        assert status.positions == before.positions and status.job_counts == before.job_counts
        assert stored_blobs(tmp_path / "ledger") == stored
        for frame in images[10:]:
            camera.put(encode_image(frame, "front"), attachment=ImageHeader(1, frame.index).encode())
        wait_for(lambda: session.ledger.status().position("keyframe") > before.position("keyframe"), "more keyframes")
        assert frontend.process.poll() is None
        wait_for(lambda: _refused_frames(session.report_of(frontend)) > LIVE_CASES / 2, "the count of refused frames")
        for service in session.services:
            assert service.process.poll() is None
            assert "Traceback" not in service.text()
        # another session's keys are nobody's
        other = keys.rpc("ledger", "append").replace("/test/", "/other/")
        with pytest.raises(Exception, match="nobody answers"):
            session.bus.request(other, b"")


@contextlib.contextmanager
def _foreign_parcels(bus: Bus, tmp_path: Path) -> Iterator[list[bytes]]:
    """Attachments that name what is there, but is no parcel, or not of this length; and what is not there."""
    if bus._parcels.greeting is None:
        yield []
        return
    folder_id = codec.decode(calls.Parcel, bus._parcels.greeting).folder_id
    folder = next(path for path in Path("/dev/shm").glob("vggt_motion-*") if _identity(path) == folder_id)
    (folder / "link").symlink_to(tmp_path / "ledger" / "ledger.db")
    os.mkfifo(folder / "pipe")
    (folder / "short").write_bytes(b"short")
    named = [calls.Parcel(folder_id, name, 2**20) for name in ("link", "pipe", "short", "nothing")]
    yield [codec.encode(parcel) for parcel in (*named, calls.Parcel("0" * 32, "short", 5))]
    for name in ("link", "pipe", "short"):
        (folder / name).unlink()


def _refused_frames(report: HealthReport | None) -> float:
    counters = {} if report is None else report.counters
    return counters.get("refused_frames", 0.0) + counters.get("unreadable_frames", 0.0)


def _is_sound(entry: str, payload: bytes) -> bool:
    try:
        ENTRIES[entry][0](payload)
    except (CodecError, RequestRefusedError):
        return False
    return True


def _settled(session: Any, refused: int) -> Any:
    status = session.ledger.status()
    return status if status.refused_request_count >= refused else None
