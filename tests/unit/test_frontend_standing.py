"""Standing against moving, on synthetic street scenes whose motion is known."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from vggt_motion.config import FrontendConfig
from vggt_motion.frontend.pipeline import FrameTrace, FrontendPipeline, KeyframeOutput
from vggt_motion.records import MotionState
from vggt_motion.sources.source import Frame

HEIGHT, WIDTH = 180, 320
RATE_HZ = 10.0


def texture(seed: int, shape: tuple[int, int] = (HEIGHT, WIDTH), scale: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal(shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), scale)
    return (120 + 40 * smooth / smooth.std()).astype(np.float32)


def zoomed(scene: np.ndarray, factor: float) -> np.ndarray:
    """The scene after driving towards it: an expansion about the centre."""
    matrix = np.array([[factor, 0, (1 - factor) * WIDTH / 2], [0, factor, (1 - factor) * HEIGHT / 2]], np.float32)
    return np.asarray(cv2.warpAffine(scene, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT))


def trace(images: Iterator[np.ndarray], rate_hz: float = RATE_HZ) -> tuple[list[FrameTrace], list[KeyframeOutput]]:
    traces: list[FrameTrace] = []
    pipeline = FrontendPipeline(FrontendConfig(), "front", on_trace=traces.append)
    outputs = []
    for index, image in enumerate(images):
        data = cv2.imencode(".png", np.clip(image, 0, 255).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        outputs += pipeline.push(Frame(index, round(index / rate_hz * 1e9), data.tobytes(), "image/png"))
    outputs += pipeline.finish()
    return traces, [output for output in outputs if isinstance(output, KeyframeOutput)]


def states(traces: list[FrameTrace]) -> str:
    return "".join(item.state.value for item in traces)


def with_noise(image: np.ndarray, rng: np.random.Generator, sigma: float) -> np.ndarray:
    return image + rng.normal(0, sigma, image.shape)


@pytest.mark.parametrize("sigma", [0.0, 3.0, 10.0])
def test_standing_with_sensor_noise(sigma: float) -> None:
    rng = np.random.default_rng(1)
    scene = texture(0)
    traces, keyframes = trace(with_noise(scene, rng, sigma) for _ in range(40))
    assert set(states(traces)) == {"S"}
    assert [k.keyframe.frame_index for k in keyframes] == [0, 39]
    assert keyframes[1].keyframe.zero_motion_copy_of == keyframes[0].keyframe.keyframe_id


@pytest.mark.parametrize("quality", [100, 20])
def test_standing_in_the_dark(quality: int) -> None:
    """A night scene: a tenth of the contrast, noise of the sensor as strong as the scene, and a codec that flickers."""
    rng = np.random.default_rng(2)
    scene = 20 + 0.1 * (texture(0) - 120)

    def images() -> Iterator[np.ndarray]:
        for _ in range(40):
            dark = np.clip(with_noise(scene, rng, 4.0), 0, 255).astype(np.uint8)
            data = cv2.imencode(".jpg", dark, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
            yield np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))

    traces, _ = trace(images())
    assert set(states(traces)) == {"S"}


def test_driving_in_the_dark() -> None:
    rng = np.random.default_rng(2)
    scene = 20 + 0.1 * (texture(0) - 120)
    traces, _ = trace(with_noise(zoomed(scene, 1.0 + 0.04 * (k % 12)), rng, 2.0) for k in range(60))
    assert "S" not in states(traces)


def test_standing_while_exposure_changes() -> None:
    scene = texture(0)
    traces, _ = trace(scene * (1.0 + 0.15 * np.sin(k / 4)) for k in range(40))
    assert set(states(traces)) == {"S"}


def test_standing_under_lamps_that_flicker_through_a_rolling_shutter() -> None:
    """Bands of brightness run down the image: each row is exposed at another moment of the lamps' 100 Hz."""
    rng = np.random.default_rng(4)
    scene, row = texture(0), np.arange(HEIGHT)[:, None]
    traces, keyframes = trace(
        with_noise(scene * (1.0 + 0.2 * np.sin(2 * np.pi * (row / 60 + 0.17 * k))), rng, 2.0) for k in range(40)
    )
    assert set(states(traces)) == {"S"}
    assert len(keyframes) == 2


def test_driving_with_dirt_on_the_windscreen() -> None:
    """Sixty spots, blurred as they are near: a tenth of the image that never moves."""
    rng = np.random.default_rng(5)
    scene, dirt = texture(0), np.zeros((HEIGHT, WIDTH), np.float32)
    for x, y in rng.integers(8, [WIDTH - 8, HEIGHT - 8], (60, 2)).tolist():
        cv2.circle(dirt, (x, y), 6, 1.0, -1)
    dirt = np.asarray(cv2.GaussianBlur(dirt, (0, 0), 1.5))
    traces, keyframes = trace(zoomed(scene, 1.0 + 0.04 * (k % 12)) * (1 - dirt) + 35 * dirt for k in range(60))
    assert "S" not in states(traces)
    without, _ = trace(zoomed(scene, 1.0 + 0.04 * (k % 12)) for k in range(60))
    assert len(keyframes) > 0.7 * sum(item.is_keyframe for item in without)


def test_a_stop_of_exact_repeats_is_standing() -> None:
    """A camera or an encoder that repeats what does not change, here after driving and before driving on."""
    scene = texture(0)
    factors = [*(1.03**k for k in range(15)), *([1.03**15] * 30), *(1.03**k for k in range(16, 28))]
    line = states(trace(zoomed(scene, factor) for factor in factors)[0])
    assert line[:12].count("S") == 0 and line[-8:].count("S") == 0
    assert "S" * 20 in line


def test_standing_while_a_lorry_crosses() -> None:
    """Half of the image is another one, moving by 8 px/frame, for two seconds."""
    rng = np.random.default_rng(3)
    scene, lorry = texture(0), texture(9, (HEIGHT, 2000))

    def images() -> Iterator[np.ndarray]:
        for k in range(100):
            image = scene.copy()
            front = -200 + 8 * (k - 20)  # the lorry is 200 px long and covers the rows 40 to 180
            left, right = max(0, front), min(WIDTH, front + 200)
            if right > left:
                image[40:, left:right] = lorry[40:, left - front + 300 : right - front + 300]
            yield with_noise(image, rng, 2.0)

    traces, keyframes = trace(images())
    assert states(traces).count("S") >= 99
    assert len(keyframes) == 2


def test_driving_with_a_static_bonnet_and_overlay() -> None:
    scene = texture(0)
    bonnet = texture(5)

    def images() -> Iterator[np.ndarray]:
        for k in range(60):
            image = zoomed(scene, 1.0 + 0.04 * (k % 12))
            image[135:] = bonnet[135:]  # a quarter of the image
            image[:15, :100] = bonnet[:15, :100]
            yield image

    traces, keyframes = trace(images())
    assert "S" not in states(traces)
    without, _ = trace(zoomed(scene, 1.0 + 0.04 * (k % 12)) for k in range(60))
    # it hides a part of the road, but does not starve the selection
    assert len(keyframes) > 0.5 * sum(item.is_keyframe for item in without)


def test_driving_under_a_textured_sky_at_rest_in_the_image() -> None:
    """Clouds do not move while we drive straight on."""
    scene, sky, bonnet = texture(0), texture(6), texture(5)

    def images() -> Iterator[np.ndarray]:
        for k in range(60):
            image = zoomed(scene, 1.0 + 0.04 * (k % 12))
            image[:80] = sky[:80]
            image[155:] = bonnet[155:]  # with the sky, 58 % of the image stand still
            yield image

    assert "S" not in states(trace(images())[0])


def test_stopping_and_driving_off() -> None:
    scene = texture(0)
    # speed in zoom per frame: drive, brake, stand for 30 frames, drive off
    speeds = [0.03] * 15 + [0.03 * (1 - k / 10) for k in range(1, 11)] + [0.0] * 30 + [0.004 * k for k in range(1, 10)]

    def images() -> Iterator[np.ndarray]:
        factor = 1.0
        for speed in speeds:
            factor *= 1 + speed
            yield zoomed(scene, factor)

    traces, keyframes = trace(images())
    line = states(traces)
    standing = range(25, 55)  # frames without motion against the one before
    assert line[:20].count("S") == 0
    assert "S" * 20 in line
    # what is called standing is; the end of braking and the start are below 0.7 px a frame at first
    assert all(k in range(standing.start - 3, standing.stop + 4) for k, state in enumerate(line) if state == "S")
    boundary = [k.keyframe for k in keyframes if k.keyframe.state is MotionState.STATIC]
    assert len(boundary) == 2
    assert boundary[1].zero_motion_copy_of == boundary[0].keyframe_id


def test_creeping_is_not_standing_for_long() -> None:
    """0.12 px a frame at the border: nothing for the flow between consecutive frames, much over seconds."""
    scene = texture(0)
    _, keyframes = trace(zoomed(scene, 1.0 + 0.002 * k) for k in range(150))
    # 0.3 in all: the median cell moves by 25 px
    indices = [k.keyframe.frame_index for k in keyframes]
    assert len(indices) >= 5
    assert max(b - a for a, b in itertools.pairwise(indices)) <= 50


def test_a_high_frame_rate_is_not_standing() -> None:
    """20 px/s seen at 60 frames/s are 0.33 px a frame, all below tau_flow."""
    scene = texture(0, (HEIGHT, WIDTH + 100))

    def images() -> Iterator[np.ndarray]:
        for k in range(120):
            matrix = np.array([[1, 0, -k / 3], [0, 1, 0]], np.float32)
            yield np.asarray(cv2.warpAffine(scene, matrix, (WIDTH + 100, HEIGHT)))[:, :WIDTH]

    line = states(trace(images(), rate_hz=60.0)[0])
    assert line[20:].count("S") == 0


def test_exact_repeats_in_a_drive_are_not_standing() -> None:
    scene = texture(0)
    factors = [1.0 + 0.03 * (k // 3) for k in range(60)]  # each image three times
    assert "S" not in states(trace((zoomed(scene, factor) for factor in factors), rate_hz=30.0)[0])
