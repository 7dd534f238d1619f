"""How far a solved submap can be trusted: a wrong one must not look right."""

from __future__ import annotations

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


def rank(solved: Structure, keyframe_count: int) -> tuple[int, int, float]:
    """Sorts solutions of the same keyframes: the verdict, then how many were registered, then how much is explained."""
    order = (SubmapVerdict.FAILED, SubmapVerdict.LOW_QUALITY, SubmapVerdict.GOOD)
    judgement, _ = judge(solved, keyframe_count)
    return order.index(judgement), int(solved.registered.sum()), solved.explained
