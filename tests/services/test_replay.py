"""Replay over a real router: what comes out of the image key is what went into the recording."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bus_processes import bus_config, free_port, running, wait_until_heard
from vggt_motion.bus.images import ImageHeader, encode_image
from vggt_motion.bus.session import open_bus
from vggt_motion.config import Config
from vggt_motion.errors import InputError, SourceError
from vggt_motion.recorder.record import FrameId, Recording
from vggt_motion.recorder.replay import replay
from vggt_motion.sources.selection import Selection
from vggt_motion.sources.source import Frame
from vggt_motion.sources.zenoh import ZenohSource

COUNT = 30
INTERVAL_NS = 20_000_000


def frame(index: int) -> Frame:
    pixels = np.random.default_rng(index).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    return Frame(index, 5 + index * INTERVAL_NS, cv2.imencode(".png", pixels)[1].tobytes(), "image/png")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    with Recording.open(path, chunk_bytes=50_000) as file:
        for index in range(COUNT):
            file.add_frame(FrameId("front", 0, index), frame(index))
    return path


@pytest.fixture
def config(tmp_path: Path) -> Iterator[Config]:
    address = f"tcp/127.0.0.1:{free_port()}"
    with running(tmp_path, "router", address):
        yield Config(bus=bus_config(address, connect_timeout_s=20.0))


class Receiver(threading.Thread):
    """Collects the frames of a source, slowly if asked to."""

    def __init__(self, source: ZenohSource, pause_s: float = 0.0) -> None:
        super().__init__(daemon=True)
        self.source, self.pause_s = source, pause_s
        source.join()
        self.frames: list[Frame] = []
        self.error: Exception | None = None
        self.start()

    def run(self) -> None:
        try:
            for item in self.source.frames():
                self.frames.append(item)
                time.sleep(self.pause_s)
        except SourceError as error:
            self.error = error

    def result(self) -> list[Frame]:
        self.join(60)
        assert not self.is_alive()
        self.source.close()
        return self.frames


def test_a_replay_gives_the_recorded_frames_and_ends(config: Config, recording: Path) -> None:
    receiver = Receiver(ZenohSource(config.bus, "front", Selection()))
    outcome = replay(recording, config, rate=100.0)
    assert (outcome.frame_count, outcome.laps, outcome.truncated) == (COUNT, 1, "")
    assert receiver.result() == [frame(index) for index in range(COUNT)]
    assert receiver.source.missing_count == receiver.source.dropped_count == 0


def test_a_slow_receiver_slows_a_replay_down_and_misses_nothing(config: Config, recording: Path) -> None:
    receiver = Receiver(ZenohSource(config.bus, "front", Selection()), pause_s=0.02)
    replay(recording, config, rate=float("inf"))
    assert receiver.result() == [frame(index) for index in range(COUNT)]


def test_frames_keep_their_distance_in_time(config: Config, recording: Path) -> None:
    begin = time.monotonic()
    replay(recording, config, rate=2.0)
    # Never faster than asked for; how much slower is the machine's affair.
    assert time.monotonic() - begin >= (COUNT - 1) * INTERVAL_NS / 1e9 / 2.0


def test_a_part_of_a_recording(config: Config, recording: Path) -> None:
    receiver = Receiver(ZenohSource(config.bus, "front", Selection()))
    outcome = replay(
        recording, config, rate=float("inf"), start_s=10 * INTERVAL_NS / 1e9, duration_s=5 * INTERVAL_NS / 1e9
    )
    frames = receiver.result()
    assert outcome.frame_count == 5
    assert [f.encoded for f in frames] == [frame(index).encoded for index in range(10, 15)]
    assert [f.index for f in frames] == list(range(5))


def test_a_loop_goes_on_in_index_and_time_until_it_is_stopped(config: Config, recording: Path) -> None:
    receiver = Receiver(ZenohSource(config.bus, "front", Selection(end=2 * COUNT + 3)))
    stopping = threading.Event()
    thread = threading.Thread(
        target=lambda: replay(recording, config, rate=float("inf"), loop=True, stopping=stopping), daemon=True
    )
    thread.start()
    frames = receiver.result()
    stopping.set()
    thread.join(60)
    assert not thread.is_alive()
    assert [f.index for f in frames] == list(range(2 * COUNT + 3))
    assert [f.encoded for f in frames] == [frame(index % COUNT).encoded for index in range(2 * COUNT + 3)]
    steps = np.diff([f.capture_time_ns for f in frames])
    assert (steps == INTERVAL_NS).all()


def test_a_broken_off_recording_is_replayed_as_far_as_it_goes(config: Config, recording: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    receiver = Receiver(ZenohSource(config.bus, "front", Selection()))
    outcome = replay(broken, config, rate=float("inf"))
    assert 0 < outcome.frame_count < COUNT
    assert "broken off" in outcome.truncated
    assert receiver.result() == [frame(index) for index in range(outcome.frame_count)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rate": 0.0}, "rate must be positive"),
        ({"rate": float("nan")}, "rate must be positive"),
        ({"start_s": -1.0}, "start must not be negative"),
        ({"duration_s": 0.0}, "duration must be positive"),
    ],
)
def test_wrong_parameters_are_refused_at_once(recording: Path, arguments: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replay(recording, Config(), **arguments)  # type: ignore[arg-type]


def test_a_start_behind_the_end_is_an_error(config: Config, recording: Path) -> None:
    with pytest.raises(InputError, match="no frame of"):
        replay(recording, config, start_s=3600.0)


def test_frames_of_a_bridge_the_newest_win(config: Config) -> None:
    """A publisher without numbers is never held up; what a slow receiver cannot take is dropped and counted."""
    source = ZenohSource(config.bus, "front", Selection())
    source.join()
    with open_bus(config.bus) as bus:
        publisher = bus.publisher(bus.keys.image("front"), blocking=True)
        wait_until_heard(bus, bus.keys.image("front"))
        frames = source.frames()
        publisher.put(encode_image(frame(0), "front"))
        first = next(frames)
        for index in range(1, COUNT):
            publisher.put(encode_image(frame(index), "front"))
        publisher.put(b"\xff no image")
        end = time.monotonic() + 60
        while source.refused_count < 1:
            assert time.monotonic() < end
            time.sleep(0.01)
        rest = [next(frames) for _ in range(8)]
        source.close()
        assert list(frames) == []
    assert first.encoded == frame(0).encoded
    assert [f.encoded for f in rest] == [frame(index).encoded for index in range(COUNT - 8, COUNT)]
    assert source.dropped_count == COUNT - 1 - 8


def test_what_is_too_large_or_cut_off_is_refused_and_its_number_stays_free(config: Config) -> None:
    source = ZenohSource(config.bus, "front", Selection())
    source.join()
    with open_bus(config.bus) as bus:
        publisher = bus.publisher(bus.keys.image("front"), blocking=True)
        wait_until_heard(bus, bus.keys.image("front"))
        whole = frame(0)
        bomb = whole.encoded[:16] + struct.pack(">II", 32_000, 32_000) + whole.encoded[24:]
        padded = whole.encoded + bytes(130_000_000 + 2**23)
        for encoded in (bomb, padded, whole.encoded[:-20], whole.encoded):
            payload = encode_image(replace(whole, encoded=encoded), "front")
            publisher.put(payload, attachment=ImageHeader(0, 0).encode())
        assert next(source.frames()) == whole
        source.close()
    assert source.refused_count == 3


def test_no_camera_is_one_clear_error(config: Config) -> None:
    source = ZenohSource(config.bus, "front", Selection(), first_frame_timeout_s=0.2)
    with pytest.raises(SourceError, match="no frame came on vggt_motion/@v1/test/camera/front/image"):
        list(source.frames())
    source.close()


def test_no_router_is_one_clear_error() -> None:
    nowhere = bus_config(f"tcp/127.0.0.1:{free_port()}", connect_timeout_s=0.3)
    source = ZenohSource(nowhere, "front", Selection())
    with pytest.raises(SourceError, match="zenoh:front: no router"):
        next(source.frames())
    source.close()
