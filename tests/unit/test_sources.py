"""Sources: what is read, in which order, with which times, and what bad input is told."""

from __future__ import annotations

import itertools
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vggt_motion.errors import InputError, SourceError, SourceTruncatedError
from vggt_motion.sources.encoded import PNG
from vggt_motion.sources.image_folder import ImageFolder, natural_key
from vggt_motion.sources.kitti import KittiFolder
from vggt_motion.sources.registry import SOURCE_KINDS, open_source
from vggt_motion.sources.source import Frame
from vggt_motion.sources.timing import CLOCK_RESET_NS, REPAIR_STEP_NS, TimestampRepair, read_times

SECOND = 1_000_000_000


def _image(value: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    rng = np.random.default_rng(value)
    return rng.integers(0, 255, (size[1], size[0]), dtype=np.uint8)


def _write_folder(folder: Path, count: int, pattern: str = "{:d}.png") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        assert cv2.imwrite(str(folder / pattern.format(k)), _image(k))
    return folder


def _write_video(path: Path, count: int, fourcc: str = "MJPG", rate: float = 20.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), rate, (160, 120))
    assert writer.isOpened()
    for k in range(count):
        frame = np.zeros((120, 160, 3), np.uint8)
        cv2.circle(frame, (10 + 4 * k, 60), 9, (40, 200, 250), -1)
        writer.write(frame)
    writer.release()
    return path


def _drain(location: Path | str, **options: int) -> tuple[list[Frame], Exception | None]:
    source = open_source(str(location), **options)
    frames: list[Frame] = []
    try:
        frames.extend(source.frames())
    except SourceTruncatedError as error:
        # extend keeps what came before the exception
        return frames, error
    finally:
        source.close()
    return frames, None


def test_folder_passes_file_bytes_through_in_natural_order(tmp_path: Path) -> None:
    folder = _write_folder(tmp_path / "images", 12)
    frames, error = _drain(folder)
    assert error is None
    assert [frame.encoded for frame in frames] == [(folder / f"{k}.png").read_bytes() for k in range(12)]
    assert [frame.index for frame in frames] == list(range(12))
    assert {frame.media_type for frame in frames} == {PNG}
    assert np.diff([frame.capture_time_ns for frame in frames]).tolist() == [SECOND // 10] * 11


def test_nominal_rate_sets_the_times_of_a_folder_without_times(tmp_path: Path) -> None:
    source = open_source(str(_write_folder(tmp_path / "images", 3)), nominal_rate_hz=25.0)
    assert [frame.capture_time_ns for frame in source.frames()] == [0, 40_000_000, 80_000_000]
    assert source.frame_rate_hz == 25.0


def test_selection_is_a_python_slice_and_renumbers(tmp_path: Path) -> None:
    folder = _write_folder(tmp_path / "images", 12)
    frames, _ = _drain(folder, start=2, end=11, stride=3)
    assert [frame.encoded for frame in frames] == [(folder / f"{k}.png").read_bytes() for k in range(12)[2:11:3]]
    assert [frame.index for frame in frames] == [0, 1, 2]


@pytest.mark.parametrize("options", [{"start": -1}, {"stride": 0}, {"start": 5, "end": 5}])
def test_malformed_selection_is_refused(tmp_path: Path, options: dict[str, int]) -> None:
    with pytest.raises(InputError):
        open_source(str(_write_folder(tmp_path / "images", 3)), **options)


def test_selection_beyond_the_end_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="select nothing"):
        open_source(str(_write_folder(tmp_path / "images", 3)), start=3)
    with pytest.raises(SourceError, match="select nothing"):
        open_source(str(_write_video(tmp_path / "v.avi", 5)), start=5)


def test_other_formats_become_png_without_loss(tmp_path: Path) -> None:
    pixels = _image(7)
    assert cv2.imwrite(str(tmp_path / "a.bmp"), pixels)
    frames, _ = _drain(tmp_path)
    assert frames[0].media_type == PNG
    decoded = cv2.imdecode(np.frombuffer(frames[0].encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(decoded, pixels)


def test_media_type_is_judged_by_content_not_by_name(tmp_path: Path) -> None:
    ok, png = cv2.imencode(".png", _image(1))
    assert ok
    (tmp_path / "a.jpg").write_bytes(png.tobytes())
    frames, _ = _drain(tmp_path)
    assert frames[0].media_type == PNG
    assert frames[0].encoded == png.tobytes()


@given(st.lists(st.integers(0, 10**6), min_size=1, unique=True))
def test_natural_key_orders_numbers_by_value(numbers: list[int]) -> None:
    names = [f"frame{number}.png" for number in numbers]
    assert sorted(names, key=natural_key) == [f"frame{number}.png" for number in sorted(numbers)]


def test_kitti_folder_with_times_and_poses(tmp_path: Path) -> None:
    _write_folder(tmp_path / "image_0", 3, "{:06d}.png")
    (tmp_path / "times.txt").write_text("0.0\n1.037e-01\n0.2073\n")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    source = open_source(str(tmp_path))
    assert isinstance(source, KittiFolder)
    assert source.ground_truth_path == tmp_path / "poses.txt"
    assert [frame.capture_time_ns for frame in source.frames()] == [0, 103_700_000, 207_300_000]


def test_colour_images_are_preferred(tmp_path: Path) -> None:
    _write_folder(tmp_path / "image_0", 2)
    colour = _write_folder(tmp_path / "image_2", 2, "{:06d}.png")
    frames, _ = _drain(tmp_path)
    assert frames[0].encoded == (colour / "000000.png").read_bytes()


def test_kitti_raw_times(tmp_path: Path) -> None:
    _write_folder(tmp_path / "image_02" / "data", 2)
    (tmp_path / "image_02" / "timestamps.txt").write_text(
        "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389445\n"
    )
    frames, _ = _drain(tmp_path)
    # 2011-09-26 13:02:25 UTC is 1317042145 s after the epoch (date -u -d ... +%s)
    assert [frame.capture_time_ns for frame in frames] == [1317042145_964389445, 1317042146_064389445]


def test_fewer_times_than_images_are_continued(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    _write_folder(tmp_path / "image_0", 4)
    (tmp_path / "times.txt").write_text("0\n0.5\n")
    with caplog.at_level(logging.WARNING):
        frames, _ = _drain(tmp_path)
    assert [frame.capture_time_ns for frame in frames] == [0, SECOND // 2, SECOND, 3 * SECOND // 2]
    assert "2 times for 4 images" in caplog.text


@pytest.mark.parametrize("text", ["0.0\nnan\n", "0.0\nabc\n", "-1\n2\n", "0\ninf\n", "0\n4.1e9\n"])
def test_bad_times_name_file_and_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "times.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=r"times\.txt, line"):
        read_times(path)


def test_repeated_and_backward_times_are_repaired_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _write_folder(tmp_path, 5)
    (tmp_path / "times.txt").write_text("0\n0.1\n0.1\n0.05\n0.4\n")
    with caplog.at_level(logging.WARNING):
        frames, _ = _drain(tmp_path)
    assert [frame.capture_time_ns for frame in frames] == [0, 100_000_000, 100_001_000, 100_002_000, 400_000_000]
    assert len(caplog.records) == 1


@given(st.lists(st.integers(0, 20 * SECOND), min_size=1, max_size=40), st.integers(1, SECOND))
def test_repaired_times_strictly_increase_and_good_ones_stay(times: list[int], interval: int) -> None:
    repair = TimestampRepair(interval)
    repaired = [repair(time) for time in times]
    assert all(b > a for a, b in itertools.pairwise(repaired))
    if all(b > a for a, b in itertools.pairwise(times)):
        assert repaired == times
        assert repair.count == 0


def test_a_clock_that_was_set_back_keeps_its_steps_afterwards() -> None:
    repair = TimestampRepair(SECOND // 10)
    start = 100 * SECOND
    times = [start, start + SECOND // 10, 0, SECOND // 10, 2 * SECOND // 10]
    assert start > CLOCK_RESET_NS
    assert np.diff([repair(time) for time in times]).tolist() == [SECOND // 10] * 4
    assert repair.count == 1
    assert REPAIR_STEP_NS < SECOND // 10


@pytest.mark.parametrize("location", ["", "/nonexistent/folder", "/nonexistent/video.mp4"])
def test_nonexistent_locations(location: str) -> None:
    with pytest.raises(SourceError):
        open_source(location)


def test_folder_without_images(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    (tmp_path / "._0001.jpg").write_text("resource fork")
    with pytest.raises(SourceError, match="no images"):
        open_source(str(tmp_path))


def test_text_named_jpg_alone_is_no_source(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("hello")
    source = open_source(str(tmp_path))
    with pytest.raises(SourceError, match=r"a\.jpg is not a readable image"):
        next(iter(source.frames()))


def test_an_image_that_was_cut_off_is_not_filled_up(tmp_path: Path) -> None:
    _write_folder(tmp_path, 3)
    path = tmp_path / "1.png"
    path.write_bytes(path.read_bytes()[:-20])
    frames, error = _drain(tmp_path)
    assert len(frames) == 1
    assert error is not None and "1.png is not a whole JPEG or PNG image" in str(error)


def test_text_named_jpg_in_the_middle_ends_the_input_there(tmp_path: Path) -> None:
    _write_folder(tmp_path, 5)
    (tmp_path / "3.png").write_text("hello")
    frames, error = _drain(tmp_path)
    assert len(frames) == 3
    assert error is not None and "frame 3" in str(error) and "3.png" in str(error)


@pytest.mark.parametrize("text", ["12.5 3 4\n" * 2000, "für alle Fälle " * 273 + "x" * 4 + "ü", "x"])
def test_text_is_no_video(tmp_path: Path, text: str) -> None:
    """FFmpeg would draw it, a letter at a time."""
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SourceError, match="is a text file, not a video"):
        open_source(str(path))


def test_raw_video_whose_pixels_look_like_letters_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "grey.y4m"
    frames = (b"FRAME\n" + b"P" * (128 * 96 * 3 // 2)) * 5
    path.write_bytes(b"YUV4MPEG2 W128 H96 F25:1 Ip A1:1 C420jpeg\n" + frames)
    assert len(list(open_source(str(path)).frames())) == 5


def test_text_named_mp4_is_no_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mp4"
    path.write_text("hello")
    with pytest.raises(SourceError, match="is a text file, not a video"):
        open_source(str(path))
    assert capfd.readouterr().err == "", "the libraries below must not add lines of their own"


def test_video_frames_times_and_determinism(tmp_path: Path) -> None:
    path = _write_video(tmp_path / "v.avi", 30)
    first, error = _drain(path)
    again, _ = _drain(path)
    assert error is None
    assert len(first) == 30 and first == again
    assert [frame.capture_time_ns for frame in first] == [k * SECOND // 20 for k in range(30)]
    # an independent reader gives the pixels, up to the loss of one JPEG at quality 95
    capture = cv2.VideoCapture(str(path))
    for frame in first:
        ok, expected = capture.read()
        assert ok
        decoded = cv2.imdecode(np.frombuffer(frame.encoded, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        assert np.abs(decoded.astype(float) - np.asarray(expected, float)).mean() < 2.0


def test_video_selection_takes_the_frames_of_the_whole(tmp_path: Path) -> None:
    path = _write_video(tmp_path / "v.avi", 30)
    whole, _ = _drain(path)
    part, error = _drain(path, start=5, end=20, stride=4)
    assert error is None
    assert [frame.encoded for frame in part] == [frame.encoded for frame in whole[5:20:4]]
    assert [frame.capture_time_ns for frame in part] == [frame.capture_time_ns for frame in whole[5:20:4]]
    assert open_source(str(path), start=5, end=20, stride=4).frame_count == len(part)


def test_video_end_bound_within_a_truncated_file_is_no_truncation(tmp_path: Path) -> None:
    path = _write_video(tmp_path / "v.avi", 40)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    frames, error = _drain(path, end=10)
    assert error is None and len(frames) == 10


@pytest.mark.parametrize("name", ["v.avi", "v.mkv"])
def test_truncated_video_keeps_what_was_read(tmp_path: Path, name: str) -> None:
    path = _write_video(tmp_path / name, 40)
    whole, error = _drain(path)
    assert error is None and len(whole) == 40
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    frames, error = _drain(path)
    assert 5 < len(frames) < 40
    assert frames == whole[: len(frames)]
    assert isinstance(error, SourceTruncatedError) and "of 40 frames" in str(error)


def test_damage_in_the_middle_of_a_video_is_reported(tmp_path: Path) -> None:
    path = _write_video(tmp_path / "v.avi", 40)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + len(data) // 5] = bytes(len(data) // 5)
    path.write_bytes(data)
    frames, error = _drain(path)
    assert 5 < len(frames) < 40
    assert isinstance(error, SourceTruncatedError)


def test_video_without_a_readable_header(tmp_path: Path) -> None:
    path = _write_video(tmp_path / "v.mp4", 40, "mp4v")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])  # the index of this file stands at its end
    with pytest.raises(SourceError):
        open_source(str(path))


def test_fingerprint_identifies_input_and_selection(tmp_path: Path) -> None:
    a = _write_folder(tmp_path / "a", 4)
    b = _write_folder(tmp_path / "b", 4)
    changed = _write_folder(tmp_path / "c", 4)
    cv2.imwrite(str(changed / "0.png"), _image(99))
    video = _write_video(tmp_path / "v.avi", 5)
    prints = [
        open_source(str(a)).fingerprint,
        open_source(str(changed)).fingerprint,
        open_source(str(a), start=1).fingerprint,
        open_source(str(a), stride=2).fingerprint,
        open_source(str(video)).fingerprint,
        open_source(str(_write_video(tmp_path / "w.avi", 6))).fingerprint,
    ]
    assert len(set(prints)) == len(prints)
    assert open_source(str(b)).fingerprint == prints[0]  # a copy is the same input


def test_every_kind_of_the_registry_names_an_opener() -> None:
    names = [kind.name for kind in SOURCE_KINDS]
    assert len(set(names)) == len(names)
    assert isinstance(open_source.__doc__, str)
    for kind in SOURCE_KINDS:
        assert kind.opener.count(":") == 1


@pytest.mark.data
def test_every_sequence_of_the_evaluation_data_opens(data_dir: Path) -> None:
    counts = {
        "kitti_00_first200": 200,
        "kitti_01_first51": 51,
        "kitti_06_first51": 51,
        "kitti_raw_road_91": 91,
        "redkitchen_first400": 400,
        "video/highway_straight.mp4": 221,
        "video/standing_at_red_light.mp4": 330,
    }
    for name, count in counts.items():
        source = open_source(str(data_dir / name))
        assert source.frame_count == count, name
        assert sum(1 for _ in source.frames()) == count, name


@pytest.mark.data
def test_redkitchen_reads_colour_not_depth(data_dir: Path) -> None:
    source = open_source(str(data_dir / "redkitchen_first400"), end=1)
    assert isinstance(source, ImageFolder)
    frame = next(iter(source.frames()))
    assert frame.encoded == (data_dir / "redkitchen_first400" / "rgb" / "000000.jpg").read_bytes()


@pytest.mark.data
def test_truncated_real_video(data_dir: Path, tmp_path: Path) -> None:
    data = (data_dir / "video" / "highway_straight.mp4").read_bytes()
    path = tmp_path / "cut.mp4"
    path.write_bytes(data[: len(data) * 6 // 10])
    frames, error = _drain(path)
    assert 100 < len(frames) < 150
    assert isinstance(error, SourceTruncatedError) and "of 221 frames" in str(error)
