"""Decoding, the lattice of cells and dense flow on images whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vggt_motion.errors import SourceError, SourceTruncatedError
from vggt_motion.frontend.flow import (
    CellGrid,
    DenseFlow,
    GreyDecoder,
    MotionProof,
    at_width,
    gradient_cells,
    resize_grey,
)
from vggt_motion.sources.source import Frame


def textured(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth random texture with structure of some pixels."""
    noise = np.random.default_rng(seed).standard_normal((height, width))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(120 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def encode(pixels: np.ndarray, index: int = 0, suffix: str = ".png") -> Frame:
    ok, data = cv2.imencode(suffix, pixels)
    assert ok
    return Frame(index, index * 100_000_000, data.tobytes(), "image/png")


@pytest.mark.parametrize(("dx", "dy"), [(3, 0), (-5, 2), (0, 4), (12, 0)])
def test_flow_of_a_shifted_image_is_the_shift(dx: int, dy: int) -> None:
    big = textured(200, 420)
    source = np.ascontiguousarray(big[50:150, 50:370])
    target = np.ascontiguousarray(big[50 - dy : 150 - dy, 50 - dx : 370 - dx])
    flow = DenseFlow().between(source, target)
    assert flow.shape == (100, 320, 2) and flow.dtype == np.float32
    inner = flow[20:-20, 30:-30]
    # DIS "fast" solves on a quarter of the resolution: 0.2 px are a twentieth of its pixel
    np.testing.assert_allclose(np.median(inner, axis=(0, 1)), [dx, dy], atol=0.2)
    assert np.mean(np.hypot(*np.moveaxis(inner - [dx, dy], -1, 0)) < 0.5) > 0.95


@pytest.mark.parametrize("height", [8, 24, 31, 40])
def test_flow_of_a_very_flat_image(height: int) -> None:
    # OpenCV's DIS itself crashes the process below 32 rows
    big = textured(height, 400)
    flow = DenseFlow().between(big[:, 40:360].copy(), big[:, 37:357].copy())
    assert flow.shape == (height, 320, 2)
    assert abs(float(np.median(flow[..., 0])) - 3.0) < 0.3


def test_flow_keeps_no_memory_of_earlier_calls() -> None:
    a, b, c = (textured(96, 320, seed) for seed in range(3))
    flow = DenseFlow()
    first = flow.between(a, b)
    flow.between(c, a)
    np.testing.assert_array_equal(flow.between(a, b), first)


def test_flow_does_not_depend_on_the_number_of_threads() -> None:
    big = textured(200, 420)
    source, target = big[50:150, 50:370].copy(), big[48:148, 47:367].copy()
    before = cv2.getNumThreads()
    results = []
    try:
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            results.append(DenseFlow().between(source, target))
    finally:
        cv2.setNumThreads(before)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_grid_samples_the_flow_at_its_centres() -> None:
    rows, columns = np.mgrid[0:97, 0:320].astype(np.float32)
    flow = np.stack([columns, rows], axis=-1)
    grid = CellGrid.of((97, 320), 320)
    assert (grid.rows, grid.columns) == (24, 80)
    np.testing.assert_array_equal(grid.sample(flow).reshape(-1, 2), grid.centres_px())


def test_gradient_cells_of_a_ramp_are_its_slopes() -> None:
    rows, columns = np.mgrid[0:64, 0:64]
    ramp = (2 * columns + rows).astype(np.uint8)
    cells = gradient_cells(ramp, CellGrid.of(ramp.shape, 320))
    np.testing.assert_allclose(cells[:-1, :-1], 3.0)


def test_thresholds_scale_with_the_working_width() -> None:
    assert at_width(0.7, 320) == pytest.approx(0.7)
    assert at_width(0.7, 640) == pytest.approx(1.4)


@pytest.mark.parametrize("size", [(376, 1241), (188, 620), (240, 320), (90, 160)])
def test_working_image_keeps_the_aspect(size: tuple[int, int]) -> None:
    small = resize_grey(textured(*size), 320)
    assert small.shape == (round(size[0] * 320 / size[1]), 320)


def test_decoder_gives_grey_of_colour_and_the_full_size() -> None:
    colour = np.zeros((120, 640, 3), np.uint8)
    colour[..., 1] = 200
    grey = GreyDecoder(320).decode(encode(colour))
    assert (grey.width_px, grey.height_px) == (640, 120)
    assert grey.pixels.shape == (60, 320)
    # ITU-R BT.601: green has the weight 0.587
    assert abs(float(grey.pixels.mean()) - 0.587 * 200) < 1.0


def test_unreadable_first_frame() -> None:
    decoder = GreyDecoder(320)
    for data in (b"", b"hello", encode(textured(50, 320)).encoded[:400]):
        with pytest.raises(SourceError, match="frame 0"):
            decoder.decode(Frame(0, 0, data, "image/png"))


def test_unreadable_later_frame_and_size_change_are_truncations_that_name_the_frame() -> None:
    decoder = GreyDecoder(320)
    decoder.decode(encode(textured(100, 320)))
    with pytest.raises(SourceTruncatedError, match="frame 7 is not a whole JPEG or PNG image; the 7 frames before"):
        decoder.decode(Frame(7, 0, b"hello", "image/png"))
    damaged = bytearray(encode(textured(100, 320)).encoded)
    damaged[len(damaged) // 2] ^= 1
    with pytest.raises(SourceTruncatedError, match="frame 8 is not a readable image; the 8 frames before"):
        decoder.decode(Frame(8, 0, bytes(damaged), "image/png"))
    with pytest.raises(SourceTruncatedError, match="frame 9 is 320x90, the frames before it are 320x100"):
        decoder.decode(encode(textured(90, 320), index=9))


def _noisy(image: np.ndarray, contrast: float, sigma: float, rng: np.random.Generator) -> np.ndarray:
    return np.clip(20 + contrast * (image - 120.0) + rng.normal(0, sigma, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("contrast", "sigma"), [(1.0, 0.0), (1.0, 10.0), (0.1, 2.0)])
def test_motion_proof_tells_motion_from_noise(contrast: float, sigma: float) -> None:
    """Left half of the scene moves by 4 px, the right half stands; what DIS finds in the noise is not believed."""
    rng = np.random.default_rng(1)
    big = textured(200, 420)
    before, after = big[20:180, 40:360].copy(), big[20:180, 40:360].copy()
    after[:, :160] = big[20:180, 36:196]
    source, target = _noisy(before, contrast, sigma, rng), _noisy(after, contrast, sigma, rng)
    flow = DenseFlow().between(source, target)
    grid = CellGrid.of(source.shape, 320)
    proven = MotionProof(grid, source.shape).cells(source, target, flow)
    assert proven[3:-3, 5:35].mean() > 0.9
    assert proven[3:-3, 46:-3].mean() < 0.1


def test_motion_proof_is_blind_to_exposure() -> None:
    source = textured(160, 320)
    target = np.clip(source * 1.2 + 5, 0, 255).astype(np.uint8)
    grid = CellGrid.of(source.shape, 320)
    still = np.zeros((160, 320, 2), np.float32)
    assert not MotionProof(grid, source.shape).cells(source, target, still).any()
