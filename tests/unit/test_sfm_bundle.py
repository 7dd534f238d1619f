"""Bundle adjustment and triangulation against closed forms and a dense reference."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import sfm_scene
from vggt_motion.geometry import se3
from vggt_motion.geometry.projection import Intrinsics
from vggt_motion.inference.sfm import bundle, focal, growth
from vggt_motion.inference.sfm.bundle import Calibration, Observations, Scene
from vggt_motion.inference.sfm.triangulation import triangulate

CAMERA = Intrinsics(400.0, 400.0, 312.0, 96.0, 620, 190, 0.02)
LENS = replace(CAMERA, k1=-0.35, k2=0.35**2)
FREE = Calibration((True, True, True, True), (0.0, 0.0, 0.0, 0.0), (math.inf,) * 4)
HELD = Calibration((False,) * 4, (0.0, 0.0, 0.0, 0.0), (math.inf,) * 4)


def disturbed(scene: Scene, size: float, seed: int = 1) -> Scene:
    rng = np.random.default_rng(seed)
    rotations = np.stack(
        [r if k == 0 else se3.so3_exp(rng.normal(scale=size * 0.02, size=3)) @ r for k, r in enumerate(scene.rotations)]
    )
    moved = scene.translations + rng.normal(scale=size * 0.1, size=scene.translations.shape)
    moved[0] = scene.translations[0]
    points = scene.points * (1.0 + rng.normal(scale=size * 0.02, size=(len(scene.points), 1)))
    return replace(scene, rotations=rotations, translations=moved, points=points)


def centres(scene: Scene) -> list[np.ndarray]:
    return [-r.T @ t for r, t in zip(scene.rotations, scene.translations, strict=True)]


@pytest.mark.parametrize("camera", [CAMERA, LENS])
def test_a_disturbed_scene_and_camera_come_back(camera: Intrinsics) -> None:
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(8, 0.9, 50.0), camera)
    start = replace(disturbed(truth, 1.0), focal_px=470.0, radial_k1=0.0, principal_u=0.0, principal_v=0.0)
    result = bundle.adjust(start, observations, FREE, 5.0, 1.0, 100, 1e-14)
    assert result.scene.focal_px == pytest.approx(camera.fx, rel=1e-4)
    assert result.scene.radial_k1 == pytest.approx(camera.k1, abs=1e-4)
    assert result.scene.radial_shape == truth.radial_shape
    assert result.scene.principal_u == pytest.approx(camera.cx - 309.5, abs=0.02)
    assert result.scene.principal_v == pytest.approx(camera.cy - 94.5, abs=0.02)
    assert sfm_scene.position_error(centres(result.scene), centres(truth)) < 1e-5
    assert np.abs(bundle.residuals(result.scene, observations)).max() < 1e-2


def test_outliers_do_not_move_the_solution() -> None:
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(6, 0.9, 20.0), CAMERA)
    pixel = observations.pixel.copy()
    wrong = np.random.default_rng(5).choice(len(pixel), len(pixel) // 12, replace=False)
    pixel[wrong] += 40.0
    bad = Observations(observations.start, observations.frame, pixel)
    result = bundle.adjust(disturbed(truth, 0.3), bad, HELD, 0.5, 1.0, 100, 1e-12)
    assert sfm_scene.position_error(centres(result.scene), centres(truth)) < 2e-3


def test_the_fixed_camera_stays_and_unseen_ones_too() -> None:
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(6, 0.9, 20.0), CAMERA)
    seen = observations.subset(observations.frame != 4)
    start = disturbed(truth, 0.3)
    result = bundle.adjust(start, seen, HELD, 2.0, 1.0, 20, fixed_frame=2).scene
    for frame in (2, 4):
        np.testing.assert_array_equal(result.rotations[frame], start.rotations[frame])
        np.testing.assert_array_equal(result.translations[frame], start.translations[frame])
    assert not np.array_equal(result.translations[0], start.translations[0])


def dense_normal_equations(
    scene: Scene, observations: Observations, robust_px: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """J^T W J and -J^T W r over cameras but the first, shared unknowns and points, by central differences."""
    cameras = 6 * (len(scene.rotations) - 1)
    size = cameras + 4 + 3 * len(scene.points)

    def moved(delta: np.ndarray) -> Scene:
        rotations, translations = scene.rotations.copy(), scene.translations.copy()
        for k in range(1, len(rotations)):
            at = 6 * (k - 1)
            rotations[k] = se3.so3_exp(delta[at : at + 3]) @ rotations[k]
            translations[k] = translations[k] + delta[at + 3 : at + 6]
        shared = scene.shared.copy()
        shared[:4] += delta[cameras : cameras + 4]
        points = scene.points + delta[cameras + 4 :].reshape(-1, 3)
        return Scene(rotations, translations, points, math.exp(shared[0]), *(float(v) for v in shared[1:]))

    columns = []
    for index in range(size):
        delta = np.zeros(size)
        delta[index] = 1e-6
        difference = bundle.residuals(moved(delta), observations) - bundle.residuals(moved(-delta), observations)
        columns.append(difference.ravel() / 2e-6)
    jacobian = np.stack(columns, axis=1)
    residual = bundle.residuals(scene, observations)
    weight = np.repeat(1.0 / (1.0 + (residual**2).sum(axis=1) / robust_px**2), 2)
    return (jacobian * weight[:, None]).T @ jacobian, -(jacobian * weight[:, None]).T @ residual.ravel(), cameras + 4


@pytest.mark.parametrize("camera", [CAMERA, LENS])
def test_reduced_system_equals_the_schur_complement_of_the_dense_one(camera: Intrinsics) -> None:
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(4, 0.9, 20.0), camera, count=25)
    seen_often = np.diff(observations.start) >= 2
    observations = observations.subset(seen_often[observations.point])
    kept = np.flatnonzero(np.diff(observations.start))
    index = np.cumsum(np.diff(observations.start) > 0) - 1
    observations = Observations.build(index[observations.point], observations.frame, observations.pixel, len(kept))
    scene = disturbed(replace(truth, points=truth.points[kept]), 0.05)
    hessian, gradient, head = dense_normal_equations(scene, observations, 2.0)
    back = np.linalg.solve(hessian[head:, head:], np.column_stack([hessian[head:, :head], gradient[head:]]))
    expected = hessian[:head, :head] - hessian[:head, head:] @ back[:, :head]
    expected_right = gradient[:head] - hessian[:head, head:] @ back[:, head]
    system, right, _, _, _ = bundle._reduce(
        scene.rotations, scene.translations, scene.points, scene.shared, observations.start, observations.frame,
        observations.pixel, 2.0, 0.0, np.ones(4, dtype=bool), np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(3),
        np.array([-1, 0, 1, 2]),
    )  # fmt: skip
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(system / scale, expected / scale, atol=2e-5)
    norm = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(right / norm, expected_right / norm, atol=1e-4 * np.abs(expected_right / norm).max())


def test_cholesky_agrees_with_numpy_and_refuses_what_is_not_positive() -> None:
    factor = np.random.default_rng(0).normal(size=(9, 9))
    matrix = factor @ factor.T + 0.1 * np.eye(9)
    solvable, solution = bundle.solve_positive(matrix, np.arange(9.0))
    assert solvable
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, np.arange(9.0)), rtol=1e-9)
    matrix[3, 3] = -1.0
    assert not bundle.solve_positive(matrix, np.arange(9.0))[0]


@pytest.mark.parametrize("turn_deg", [0.0, 40.0])
def test_focal_sigma_is_the_scatter_over_noise(turn_deg: float) -> None:
    camera = Intrinsics.centred(400.0, 620, 190)
    only_focal = Calibration((True, False, False, False), (0.0,) * 4, (math.inf,) * 4)
    noise_px = 0.1
    logs, sigmas = [], []
    for seed in range(24):
        truth, observations = sfm_scene.synthetic_problem(
            sfm_scene.drive(7, 0.9, turn_deg), camera, 200, noise_px, seed=100
        )
        noisy = observations.pixel + np.random.default_rng(seed).normal(scale=noise_px, size=observations.pixel.shape)
        seen = Observations(observations.start, observations.frame, noisy)
        result = bundle.adjust(truth, seen, only_focal, 50.0, 1.0, 60, 1e-10).scene
        logs.append(math.log(result.focal_px))
        information = bundle.shared_information(result, seen, only_focal, 50.0)
        sigmas.append(noise_px / math.sqrt(information[0, 0]))
    # 24 samples tell a deviation to 15 %; three of those either way
    assert 0.55 < np.std(logs) / np.median(sigmas) < 1.6


def test_a_straight_drive_says_that_it_cannot_see_the_focal_length() -> None:
    camera = Intrinsics.centred(400.0, 620, 190)
    sigmas = {}
    for turn_deg in (0.0, 60.0):
        scene, observations = sfm_scene.synthetic_problem(sfm_scene.drive(10, 0.9, turn_deg), camera, 400, 0.1)
        calibration = focal.CameraPrior().calibration(620)
        information = bundle.shared_information(scene, observations, calibration, 0.5)
        sigmas[turn_deg] = focal.relative_sigma(information, calibration)
    assert sigmas[0.0] > 5.0 * sigmas[60.0]


def test_a_prior_holds_what_the_observations_do_not_see() -> None:
    camera = Intrinsics.centred(400.0, 620, 190)
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(8, 0.9, 0.0), camera, 200, 0.3)
    sure = focal.CameraPrior(410.0 / 620, 0.005).calibration(620)
    result = bundle.adjust(truth, observations, sure, 0.5, focal.PIXEL_SIGMA, 60, 1e-9).scene
    assert result.focal_px == pytest.approx(410.0, rel=0.01)
    fixed = focal.CameraPrior(450.0 / 620, 0.0, 0.0, is_fixed=True).calibration(620)
    start = replace(truth, focal_px=450.0)
    assert bundle.adjust(start, observations, fixed, 0.5, 1.0, 60, 1e-9).scene.focal_px == pytest.approx(
        450.0, rel=1e-12
    )


def test_triangulation_is_exact_and_shrugs_off_a_wrong_ray() -> None:
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(6, 0.9, 20.0), CAMERA)
    often = np.diff(observations.start) >= 5
    rays = growth.rays_of(observations, truth)
    arguments = (observations.start, observations.frame, 1.0 / CAMERA.fx)
    points, valid = triangulate(truth.rotations, truth.translations, rays, *arguments)
    assert valid[often].all()
    np.testing.assert_allclose(points[often], truth.points[often], rtol=1e-5, atol=1e-5)
    last = np.zeros(len(rays), dtype=bool)
    last[observations.start[1:][often] - 1] = True
    rays[last] += 0.05
    points, valid = triangulate(truth.rotations, truth.translations, rays, *arguments)
    assert valid[often].mean() > 0.97  # where all rays are nearly one, the wrong one can win
    error = np.linalg.norm(points - truth.points, axis=1) / np.linalg.norm(truth.points, axis=1)
    assert np.median(error[often]) < 0.02
    assert not valid[np.diff(observations.start) < 2].any()


def test_a_point_behind_the_cameras_is_refused() -> None:
    rotations = np.stack([np.eye(3)] * 2)
    translations = np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    rays = np.array([[-0.1, 0.0], [0.1, 0.0]])  # diverge: they meet behind
    _, valid = triangulate(rotations, translations, rays, np.array([0, 2]), np.array([0, 1]), 0.01)
    assert not valid[0]


def test_resection_finds_the_camera_among_outliers() -> None:
    truth, observations = sfm_scene.synthetic_problem(sfm_scene.drive(3, 0.9, 10.0), CAMERA)
    rows = np.flatnonzero(observations.frame == 2)
    points, pixels = truth.points[observations.point[rows]], observations.pixel[rows].copy()
    pixels[::4] += np.array([30.0, -20.0])
    _, rotation, translation = growth.refine_pose(
        truth.rotations[1].copy(), truth.translations[1].copy(), points, pixels, truth.shared, growth.WIDE_TO_NARROW
    )
    np.testing.assert_allclose(rotation, truth.rotations[2], atol=1e-4)
    np.testing.assert_allclose(translation, truth.translations[2], atol=1e-3)


@pytest.mark.parametrize("turn_deg", [0.0, 45.0])
def test_growth_places_all_frames(turn_deg: float) -> None:
    poses = sfm_scene.drive(9, 0.9, turn_deg)
    truth, observations = sfm_scene.synthetic_problem(poses, CAMERA, 500, 0.2)
    nothing = np.zeros((0, 3))
    camera = Scene(np.zeros((0, 3, 3)), nothing, nothing, CAMERA.fx)
    grown = growth.grow(observations, len(poses), camera, focal.CameraPrior(CAMERA.fx / 620, 0.05).calibration(620))
    assert grown is not None
    assert grown.registered.all()
    assert sfm_scene.position_error(centres(grown.scene), centres(truth)) < 0.01
