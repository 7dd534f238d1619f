"""One predict job from encoded images to encoded geometry: what an inference worker runs in its child process."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.bus.depth import encode_depth
from vggt_motion.config import InferenceConfig
from vggt_motion.errors import PredictionError
from vggt_motion.geometry import se3
from vggt_motion.inference.predictor import KeyframeImage, PredictionHints, Predictor
from vggt_motion.inference.registry import create_predictor
from vggt_motion.records import BlobRef, FrameGeometry, PredictTask, SubmapGeometry

DEPTH_MEDIA_TYPE = "application/vnd.vggt-motion.depth"


def predict_submap(
    task: PredictTask, images: Sequence[bytes], ego_mask: bytes | None, config: InferenceConfig
) -> tuple[SubmapGeometry, tuple[bytes, ...]]:
    """Decode the keyframes, predict, and encode the geometry for the log.

    Args:
        task: what to predict.
        images: encoded image of each of ``task.keyframes``.
        ego_mask: PNG, non-zero where a pixel must not be used.
        config: selects the predictor.

    Returns:
        The record of the submap stream, and the depth payloads that it refers to.

    Raises:
        PredictionError: an image cannot be decoded, or the images differ in size.
    """
    begin = time.perf_counter()
    decoded = [
        KeyframeImage(keyframe.keyframe_id, keyframe.capture_time_ns, _decode_rgb(image, keyframe.keyframe_id))
        for keyframe, image in zip(task.keyframes, images, strict=True)
    ]
    shapes = {image.pixels.shape for image in decoded}
    if len(shapes) > 1:
        raise PredictionError(f"the keyframes differ in size: {sorted(shapes)}")
    position = {keyframe.keyframe_id: index for index, keyframe in enumerate(task.keyframes)}
    hints = PredictionHints(
        focal=task.spec.focal_hint,
        ego_mask=None if ego_mask is None else _decode_mask(ego_mask, decoded[0].pixels.shape[:2]),
        zero_motion_copies={position[copy]: position[original] for copy, original in task.spec.zero_motion_copies},
        loop_positions=frozenset(position[keyframe_id] for keyframe_id in task.spec.loop_keyframe_ids),
    )
    decode_seconds = time.perf_counter() - begin
    prediction = _predictor(config).predict(decoded, hints)
    begin = time.perf_counter()
    # The submap's frame is that of its first camera, whatever the predictor chose: so the world begins there too.
    submap_from_predicted = se3.inverse(prediction.frames[0].submap_from_camera) if prediction.frames else np.eye(4)
    frames, blobs = [], []
    for frame in prediction.frames:
        blob = encode_depth(frame.depth, frame.confidence)
        ref = BlobRef(hashlib.sha256(blob).hexdigest(), len(blob), DEPTH_MEDIA_TYPE)
        keyframe_id = task.keyframes[frame.position].keyframe_id
        submap_from_camera = submap_from_predicted @ frame.submap_from_camera
        frames.append(FrameGeometry(keyframe_id, frame.intrinsics, submap_from_camera, ref))
        blobs.append(blob)
    seconds = dict(prediction.stage_seconds)
    seconds.update(decode=decode_seconds, encode=time.perf_counter() - begin)
    geometry = SubmapGeometry(
        spec=task.spec,
        verdict=prediction.verdict,
        reason=prediction.reason,
        scale_kind=prediction.scale_kind,
        model=prediction.model,
        frames=tuple(frames),
        quality=prediction.quality,
        stage_seconds=seconds,
    )
    return geometry, tuple(blobs)


def load_predictor(config: InferenceConfig) -> None:
    """Import and build the predictor in this process, so that what is missing is said before the first job.

    Raises:
        ConfigurationError: the predictor is unknown.
        MissingDependencyError: its packages or weights are absent.
    """
    _predictor(config)


@lru_cache(maxsize=1)
def _predictor_of(name: str, config_json: str) -> Predictor:
    # Parallelism comes from workers: two single-threaded ones use two cores best, and one thread repeats bit for bit.
    cv2.setNumThreads(1)
    return create_predictor(name, InferenceConfig.model_validate_json(config_json))


def _predictor(config: InferenceConfig) -> Predictor:
    return _predictor_of(config.predictor, config.model_dump_json())


def _decode_rgb(encoded: bytes, keyframe_id: str) -> npt.NDArray[np.uint8]:
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise PredictionError(f"keyframe {keyframe_id}: the image cannot be decoded")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _decode_mask(encoded: bytes, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    mask = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != shape:
        raise PredictionError("the ego mask cannot be decoded, or is not of the size of the images")
    return np.asarray(mask > 0)
