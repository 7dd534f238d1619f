"""Anchors: which frames, which pixels, the ladder of fall-backs, and refusals of degenerate views."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from street import SMALL_CAMERA, drive, view
from vggt_motion.bus import codec
from vggt_motion.bus.depth import decode_depth, encode_depth
from vggt_motion.config import RegistrationConfig
from vggt_motion.geometry import se3, sim3
from vggt_motion.geometry.sim3 import Sim3
from vggt_motion.inference.predictor import KeyframeImage, PredictedFrame
from vggt_motion.inference.sky import SkyMasking
from vggt_motion.records import Constraint, ConstraintKind, RegistrationSpec
from vggt_motion.registration.anchors import AnchorView, SharedFrame, register

CONFIG = RegistrationConfig(confidence_value=0.0)
I_FROM_WORLD = sim3.exp(np.array([0.1, -0.4, 0.05, 2.0, 1.0, -3.0, 0.3]))
J_FROM_WORLD = sim3.exp(np.array([-0.2, 0.3, 0.0, -1.0, 0.5, 4.0, -0.2]))
TRUTH = J_FROM_WORLD @ I_FROM_WORLD.inverse()


def overlap(count: int = 5, noise: float = 0.0, outliers: float = 0.0) -> list[SharedFrame]:
    frames = []
    for k, pose in enumerate(drive(count)):
        rng = np.random.default_rng(k)
        factors = []
        for _ in range(2):
            size = (SMALL_CAMERA.height_px, SMALL_CAMERA.width_px)
            wrong = rng.random(size) < outliers
            factors.append(1 + noise * rng.normal(size=size) + np.where(wrong, rng.uniform(0.3, 2, size), 0.0))
        in_i, in_j = (
            view(pose, x, SMALL_CAMERA, f) for x, f in zip((I_FROM_WORLD, J_FROM_WORLD), factors, strict=True)
        )
        frames.append(SharedFrame(f"k{k}", in_i, in_j))
    return frames


def spec_of(count: int = 5, kind: ConstraintKind = ConstraintKind.ADJACENT) -> RegistrationSpec:
    return RegistrationSpec(3, 4, 1, 1, kind, tuple(f"k{k}" for k in range(count)))


def spoil(frame: SharedFrame, **changes: object) -> SharedFrame:
    """The frame with fields of its view in j replaced."""
    return replace(frame, in_j=replace(frame.in_j, **changes))  # type: ignore[arg-type]


def close(got: Sim3, rotation: float, translation: float, log_scale: float) -> bool:
    delta = got @ TRUTH.inverse()
    return (
        np.linalg.norm(se3.so3_log(delta.rotation)) < rotation
        and np.linalg.norm(got.translation - TRUTH.translation) < translation
        and abs(np.log(delta.scale)) < log_scale
    )


@pytest.mark.parametrize(
    ("anchor", "expected"),
    [("window1", ("k2",)), ("window3", ("k1", "k2", "k3")), ("full", tuple(f"k{k}" for k in range(7)))],
)
def test_the_anchor_is_the_middle_of_the_overlap(anchor: str, expected: tuple[str, ...]) -> None:
    count = 7 if anchor == "full" else 5
    constraint = register(spec_of(count), overlap(count), CONFIG.model_copy(update={"anchor": anchor}))
    assert constraint.accepted, constraint.reason
    assert constraint.attempts[-1].keyframe_ids == expected
    assert close(constraint.j_from_i, 1e-4, 2e-3, 1e-4)
    assert constraint.inlier_ratio == 1.0


def test_noise_and_outliers() -> None:
    constraint = register(spec_of(), overlap(noise=0.02, outliers=0.1), CONFIG)
    assert constraint.accepted
    assert close(constraint.j_from_i, 0.005, 0.1, 0.005)
    assert 0.6 < constraint.inlier_ratio < 0.95
    eigenvalues = np.linalg.eigvalsh(constraint.information)
    assert eigenvalues[0] > 0


def test_a_missing_middle_frame_is_replaced_by_its_neighbour() -> None:
    frames = [frame for frame in overlap() if frame.keyframe_id != "k2"]
    constraint = register(spec_of(), frames, CONFIG)
    assert constraint.attempts[0].keyframe_ids == ("k1",)
    assert close(constraint.j_from_i, 1e-4, 2e-3, 1e-4)


def test_a_failed_anchor_falls_back_to_wider_ones_and_each_attempt_is_recorded() -> None:
    frames = overlap()
    rng = np.random.default_rng(0)
    shape = frames[2].in_j.depth.shape
    frames[2] = spoil(frames[2], depth=rng.uniform(1, 50, shape).astype(np.float32))
    constraint = register(spec_of(), frames, CONFIG)
    assert constraint.accepted
    assert [attempt.anchor for attempt in constraint.attempts] == ["window1", "window3"]
    assert constraint.attempts[0].outcome not in ("", "accepted")
    assert constraint.attempts[1].outcome == "accepted"
    assert close(constraint.j_from_i, 0.01, 0.2, 0.02)


def test_loop_anchor_is_one_frame_and_has_no_wider_one() -> None:
    frames = overlap(1)
    constraint = register(spec_of(1, ConstraintKind.LOOP), frames, CONFIG)
    assert constraint.accepted and len(constraint.attempts) == 1
    assert close(constraint.j_from_i, 1e-4, 2e-3, 1e-4)


def test_metric_submaps_keep_their_scale() -> None:
    rigid_i = Sim3(I_FROM_WORLD.rotation, I_FROM_WORLD.translation)
    rigid_j = Sim3(J_FROM_WORLD.rotation, J_FROM_WORLD.translation)
    frames = [
        SharedFrame(f"k{k}", view(pose, rigid_i, SMALL_CAMERA), view(pose, rigid_j, SMALL_CAMERA))
        for k, pose in enumerate(drive(5))
    ]
    constraint = register(spec_of(), frames, CONFIG, fix_scale=True)
    assert constraint.accepted and constraint.j_from_i.scale == 1.0
    np.testing.assert_allclose(constraint.j_from_i.matrix(), (rigid_j @ rigid_i.inverse()).matrix(), atol=2e-3)


def test_low_confidence_pixels_are_masked() -> None:
    """The wrong half of the image has the lower confidence, and the upper half of the confidences is used."""
    frames = overlap()
    spoiled = []
    for frame in frames:
        depth, confidence = frame.in_j.depth.copy(), frame.in_j.confidence.copy()
        depth[:, : depth.shape[1] // 2] *= 1.7
        confidence[:, : depth.shape[1] // 2] = 0.3
        spoiled.append(spoil(frame, depth=depth, confidence=confidence))
    for mode, value in (("quantile", 0.5), ("absolute", 0.5), ("mean_coef", 1.0), ("median_coef", 1.0)):
        config = CONFIG.model_copy(update={"confidence_mode": mode, "confidence_value": value})
        constraint = register(spec_of(), spoiled, config)
        assert constraint.accepted, (mode, constraint.reason)
        assert close(constraint.j_from_i, 1e-3, 2e-2, 1e-3), mode
        assert constraint.inlier_ratio == 1.0


def _constant_depth(frame: SharedFrame) -> SharedFrame:
    return spoil(frame, depth=np.full_like(frame.in_j.depth, 7.0))


def _no_confidence(frame: SharedFrame) -> SharedFrame:
    return spoil(frame, confidence=np.zeros_like(frame.in_j.confidence))


def _nan(frame: SharedFrame) -> SharedFrame:
    return spoil(frame, depth=np.full_like(frame.in_j.depth, np.nan))


def _one_row(frame: SharedFrame) -> SharedFrame:
    """A plane seen edge-on: only pixels of a narrow band are left."""
    confidence = np.zeros_like(frame.in_j.confidence)
    confidence[24:26] = 1.0
    return spoil(frame, confidence=confidence)


def _far(frame: SharedFrame) -> SharedFrame:
    """Depths as of a camera that does not move against them."""
    pose = frame.in_j.submap_from_camera.copy()
    pose[:3, 3] = 1e-4 * pose[:3, 3]
    return spoil(frame, submap_from_camera=pose)


def _mirrored(frame: SharedFrame) -> SharedFrame:
    """Cameras that turn away from what the points say."""
    turned = frame.in_j.submap_from_camera @ se3.make(se3.so3_exp(np.array([0.0, 0.6, 0.0])), np.zeros(3))
    rays_of = frame.in_j.depth[:, ::-1].copy()
    return spoil(frame, depth=rays_of, submap_from_camera=turned)


def _other_size(frame: SharedFrame) -> SharedFrame:
    return spoil(frame, depth=frame.in_j.depth[:-1], confidence=frame.in_j.confidence[:-1])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_constant_depth, "one depth"),
        (_no_confidence, "valid pixels"),
        (_nan, "valid pixels"),
        (_one_row, "line"),
        (_far, "far"),
        (_mirrored, ""),
        (_other_size, "different sizes"),
    ],
)
def test_degenerate_views_are_refused_with_a_reason(damage, words: str) -> None:  # type: ignore[no-untyped-def]
    config = CONFIG.model_copy(update={"min_points": 100})
    # as a loop: adjacent submaps may still be joined by their cameras
    constraint = register(spec_of(kind=ConstraintKind.LOOP), [damage(frame) for frame in overlap()], config)
    assert not constraint.accepted
    assert words in constraint.reason and constraint.reason
    assert len(constraint.attempts) >= 2
    assert not any(attempt.outcome == "accepted" for attempt in constraint.attempts)


@pytest.mark.parametrize("damage", [_constant_depth, _no_confidence, _nan, _one_row, _other_size])
def test_cameras_that_agree_join_adjacent_submaps_whose_points_do_not(damage) -> None:  # type: ignore[no-untyped-def]
    config = CONFIG.model_copy(update={"min_points": 100})
    constraint = register(spec_of(), [damage(frame) for frame in overlap()], config)
    assert constraint.accepted
    assert [attempt.anchor for attempt in constraint.attempts][-1] == "cameras"
    assert all(attempt.outcome != "accepted" for attempt in constraint.attempts[:-1])
    assert close(constraint.j_from_i, 1e-6, 1e-6, 1e-6)
    # they are worth less than points that fit
    good = register(spec_of(), overlap(), CONFIG)
    assert np.linalg.eigvalsh(constraint.information).max() < np.linalg.eigvalsh(good.information).max()


def test_cameras_that_disagree_join_nothing() -> None:
    frames = [_nan(frame) for frame in overlap()]
    rng = np.random.default_rng(0)
    moved = [
        spoil(f, submap_from_camera=f.in_j.submap_from_camera @ se3.exp(rng.normal(0, [0.05] * 3 + [0.3] * 3)))
        for f in frames
    ]
    constraint = register(spec_of(), moved, CONFIG)
    assert not constraint.accepted and "cameras: the submaps disagree" in constraint.reason
    assert not register(spec_of(2), frames[:2], CONFIG).accepted


def test_no_shared_frame_is_refused() -> None:
    constraint = register(spec_of(), [], CONFIG)
    assert not constraint.accepted and "no keyframe" in constraint.reason


@pytest.mark.parametrize("frames", [overlap(), [_nan(frame) for frame in overlap()], []], ids=["good", "nan", "none"])
def test_constraints_survive_the_wire(frames: list[SharedFrame]) -> None:
    constraint = register(spec_of(), frames, CONFIG)
    back = codec.decode(Constraint, codec.encode(constraint))
    assert back.accepted == constraint.accepted and back.reason == constraint.reason
    assert [attempt.outcome for attempt in back.attempts] == [attempt.outcome for attempt in constraint.attempts]
    np.testing.assert_array_equal(back.information, constraint.information)


def test_views_share_no_state_with_the_result() -> None:
    frames = overlap(1)
    before = frames[0].in_i.depth.copy()
    register(spec_of(1), frames, CONFIG)
    np.testing.assert_array_equal(frames[0].in_i.depth, before)
    assert isinstance(frames[0].in_i, AnchorView)


def turned_only(frame: SharedFrame, side: str) -> SharedFrame:
    """What a submap without translations knows of a frame: its rotation."""
    seen: AnchorView = getattr(frame, side)
    pose = se3.make(seen.submap_from_camera[:3, :3], np.zeros(3))
    nothing = np.zeros_like(seen.depth)
    return replace(frame, **{side: replace(seen, depth=nothing, confidence=nothing, submap_from_camera=pose)})  # type: ignore[arg-type]


@pytest.mark.parametrize("side", ["in_i", "in_j"])
def test_a_submap_that_only_turned_is_joined_by_its_rotations(side: str) -> None:
    frames = overlap()
    constraint = register(spec_of(), [turned_only(frame, side) for frame in frames], RegistrationConfig())
    assert constraint.accepted
    assert constraint.attempts[-1].anchor == "rotation"
    truth = TRUTH
    turned = np.linalg.norm(se3.so3_log(constraint.j_from_i.rotation @ truth.rotation.T))
    assert turned < 1e-6
    # the last camera is at one place in both, and the unit is carried over
    last = turned_only(frames[-1], side)
    at = constraint.j_from_i.act(last.in_i.submap_from_camera[:3, 3])
    np.testing.assert_allclose(at, last.in_j.submap_from_camera[:3, 3], atol=1e-9)
    assert constraint.j_from_i.scale == 1.0
    deviations = np.sqrt(np.diag(np.linalg.inv(constraint.information)))
    assert deviations[6] > 0.4 and deviations[:3].max() < 0.02  # the scale is an assumption, the rotation is not


def test_a_submap_that_only_turned_is_not_joined_against_its_rotations() -> None:
    frames = [turned_only(frame, "in_j") for frame in overlap()]
    for k, frame in enumerate(frames):
        pose = frame.in_j.submap_from_camera @ se3.make(se3.so3_exp(np.array([0.0, 0.2 * (-1) ** k, 0.0])), np.zeros(3))
        frames[k] = spoil(frame, submap_from_camera=pose)
    assert not register(spec_of(), frames, RegistrationConfig()).accepted


class _Named:
    """As much of a predictor as the masking of a single frame needs."""

    name = "stub"


class _WholeSkyAbove:
    """A segmenter that takes the upper rows for sky."""

    rows = 15

    def sky(self, pixels: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
        mask = np.zeros((height_px, width_px), dtype=np.bool_)
        mask[: self.rows] = True
        return mask


def test_sky_that_a_predictor_or_the_sky_model_found_takes_no_part() -> None:
    """Networks give sky a confident and arbitrary depth; masked, encoded and decoded, none of it reaches the fit."""
    rng = np.random.default_rng(0)
    frames = overlap()

    def through_the_wire(view: AnchorView, *, is_masked: bool) -> AnchorView:
        depth = view.depth.copy()
        depth[: _WholeSkyAbove.rows] = rng.uniform(100, 900, (_WholeSkyAbove.rows, depth.shape[1]))
        predicted = PredictedFrame(0, depth, view.confidence, view.intrinsics, view.submap_from_camera)
        if is_masked:
            masking = SkyMasking(_Named(), _WholeSkyAbove())  # type: ignore[arg-type]
            image = KeyframeImage("k", 0, np.zeros((48, 160, 3), np.uint8))
            predicted = masking._masked(predicted, image)
        depth, confidence = decode_depth(encode_depth(predicted.depth, predicted.confidence))
        return replace(view, depth=depth, confidence=confidence)

    def seen(*, is_masked: bool) -> Constraint:
        shared = [
            SharedFrame(
                f.keyframe_id,
                through_the_wire(f.in_i, is_masked=is_masked),
                through_the_wire(f.in_j, is_masked=is_masked),
            )
            for f in frames
        ]
        return register(spec_of(), shared, CONFIG)

    masked, plain = seen(is_masked=True), seen(is_masked=False)
    surface = SMALL_CAMERA.width_px * (SMALL_CAMERA.height_px - _WholeSkyAbove.rows)
    assert masked.accepted and masked.point_count == surface and masked.inlier_ratio == 1.0
    assert close(masked.j_from_i, 1e-3, 2e-2, 1e-3)
    assert plain.point_count > surface and plain.inlier_ratio < 0.8


def test_the_baseline_of_the_peers_is_a_configuration() -> None:
    """The whole overlap, absolute Huber residuals of width 0.1, five iterations, least-squares scale."""
    peers = CONFIG.model_copy(
        update={"anchor": "full", "residual": "absolute", "max_iterations": 5, "scale_rule": "least_squares"}
    )
    assert peers.huber_absolute == 0.1
    constraint = register(spec_of(), overlap(noise=0.01), peers)
    assert constraint.accepted and [attempt.anchor for attempt in constraint.attempts] == ["full"]
    assert constraint.attempts[0].keyframe_ids == tuple(f"k{k}" for k in range(5))
    assert close(constraint.j_from_i, 0.005, 0.1, 0.01)


def test_the_kernels_are_loaded_before_the_first_job() -> None:
    script = """
from vggt_motion.config import RegistrationConfig
from vggt_motion.registration.task import load_kernels
load_kernels(RegistrationConfig())
from vggt_motion.registration import kernels
print(*(len(kernel.signatures) for kernel in (kernels.unproject_pair, kernels.accumulate, kernels.score)))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1", "1"]
