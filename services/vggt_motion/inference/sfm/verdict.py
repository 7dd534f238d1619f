"""How far a solved submap can be trusted: a wrong one must not look right."""

from __future__ import annotations

import math

import numpy as np

from vggt_motion.inference.sfm import focal
from vggt_motion.inference.sfm.structure import Structure
from vggt_motion.records import SubmapVerdict

_MIN_POINTS = 25
_MIN_EXPLAINED = 0.3  # share of observations below which the scene is an accident
_MIN_EXPLAINED_BY_TWO = 0.6  # two views agree with anything along the epipolar lines
_GOOD_EXPLAINED = 0.45
_GOOD_REPROJECTION_PX = 0.75
_GOOD_REGISTERED = 0.8
_GOOD_PARALLAX_DEG = 0.3
_GOOD_FRAME_OBSERVATIONS = 15
_CONVINCING_REPROJECTION_PX = 0.3
_CONVINCING_EXPLAINED = 0.88
_GOOD_SHARE = 0.4
_GOOD_LINK = 25


def judge(solved: Structure, keyframe_count: int) -> tuple[SubmapVerdict, str]:
    """The verdict, and one line of reasons (empty when good).

    Args:
        solved: the structure.
        keyframe_count: how many keyframes it should have registered.
    """
    registered = int(solved.registered.sum())
    points = int((np.diff(solved.observations.start) >= 2).sum())
    if registered < min(3, keyframe_count) or registered < 2:
        return SubmapVerdict.FAILED, f"only {registered} of {keyframe_count} keyframes agree on a scene"
    if points < _MIN_POINTS:
        return SubmapVerdict.FAILED, f"only {points} points could be placed"
    least = _MIN_EXPLAINED_BY_TWO if registered == 2 else _MIN_EXPLAINED
    if solved.explained < least:
        return SubmapVerdict.FAILED, f"the best scene explains only {solved.explained:.0%} of the observations"
    reasons = []
    if not focal.is_plausible(solved.focal_over_width):
        reasons.append(f"the focal length came out as {solved.focal_over_width:.2f} image widths")
    if registered < _GOOD_REGISTERED * keyframe_count:
        reasons.append(f"only {registered} of {keyframe_count} keyframes registered")
    if solved.explained < _GOOD_EXPLAINED:
        reasons.append(f"only {solved.explained:.0%} of the observations explained")
    if solved.reprojection_px > _GOOD_REPROJECTION_PX:
        reasons.append(f"mean reprojection error {solved.reprojection_px:.2f} px")
    if solved.median_parallax_deg < _GOOD_PARALLAX_DEG:
        reasons.append(f"median parallax {solved.median_parallax_deg:.2f} degrees")
    fewest = int(np.bincount(solved.observations.frame, minlength=len(solved.registered))[solved.registered].min())
    if fewest < _GOOD_FRAME_OBSERVATIONS:
        reasons.append(f"a keyframe hangs on {fewest} observations")
    if solved.weakest_share < _GOOD_SHARE:
        reasons.append(f"over one step only {solved.weakest_share:.0%} of the tracks fit")
    if registered > 2 and solved.weakest_link < _GOOD_LINK:
        reasons.append(f"over one step only {solved.weakest_link} points carry the scale")
    return (SubmapVerdict.LOW_QUALITY if reasons else SubmapVerdict.GOOD), "; ".join(reasons)


def is_convincing(solved: Structure, keyframe_count: int) -> bool:
    """Whether it is so good that no other way need be tried.

    A scene can be bent and still explain four fifths of the tracks, but it does so badly.
    """
    if judge(solved, keyframe_count)[0] is not SubmapVerdict.GOOD:
        return False
    return solved.reprojection_px < _CONVINCING_REPROJECTION_PX or solved.explained > _CONVINCING_EXPLAINED


def rank(solved: Structure, keyframe_count: int) -> tuple[int, int, float]:
    """Sorts solutions of the same keyframes: the verdict, how many were registered, how much fits and how well."""
    order = (SubmapVerdict.FAILED, SubmapVerdict.LOW_QUALITY, SubmapVerdict.GOOD)
    judgement, _ = judge(solved, keyframe_count)
    sharpness = 1.0 / (1.0 + (solved.reprojection_px / _CONVINCING_REPROJECTION_PX) ** 2)
    return order.index(judgement), int(solved.registered.sum()), solved.explained * sharpness


def focal_deviations(one: Structure, other: Structure) -> float:
    """How far apart two solutions have the focal length, in standard deviations; 0 where one of them held it."""
    sigma = math.hypot(one.focal_relative_sigma, other.focal_relative_sigma)
    return abs(math.log(one.focal_over_width / other.focal_over_width)) / sigma if math.isfinite(sigma) else 0.0


def disagreement(one: Structure, other: Structure) -> float:
    """How far apart two solutions put the cameras, after the best similarity, as a share of the path; 0 if too few."""
    first, second = one.camera_from_submap(), other.camera_from_submap()
    shared = sorted(set(first) & set(second))
    if len(shared) < 3:
        return 0.0
    a, b = (np.stack([-poses[p][:3, :3].T @ poses[p][:3, 3] for p in shared]) for poses in (first, second))
    length = float(np.linalg.norm(np.diff(b, axis=0), axis=1).sum())
    centred_a, centred_b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(centred_b.T @ centred_a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    spread = float((centred_a**2).sum())
    if length <= 0.0 or spread <= 0.0:
        return 0.0
    scale = float((s * signs).sum()) / spread
    errors = np.linalg.norm(scale * centred_a @ (u * signs @ vt).T - centred_b, axis=1)
    return float(np.sqrt((errors**2).mean())) / length
