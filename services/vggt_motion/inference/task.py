"""One predict job from encoded images to encoded geometry: what an inference worker runs in its child process."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import time
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from vggt_motion.bus.depth import encode_depth
from vggt_motion.config import InferenceConfig
from vggt_motion.errors import CodecError, PredictionError
from vggt_motion.geometry import se3
from vggt_motion.inference.predictor import (
    BatchPredictor,
    KeyframeImage,
    Prediction,
    PredictionHints,
    Predictor,
)
from vggt_motion.inference.registry import choose_predictor, create_predictor
from vggt_motion.records import BlobRef, FrameGeometry, PredictTask, SubmapGeometry
from vggt_motion.sources.encoded import decode_rgb

_log = logging.getLogger(__name__)
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
    decoded, hints, decode_seconds = _decoded(task, images, ego_mask)
    prediction = _predictor(config).predict(decoded, hints)
    return _encoded(task, prediction, decode_seconds)


def predict_submaps(
    requests: Sequence[tuple[PredictTask, Sequence[bytes], bytes | None, InferenceConfig]],
) -> list[tuple[SubmapGeometry, tuple[bytes, ...]] | str]:
    """Several jobs of one configuration together, as :func:`predict_submap` does one by one.

    Returns:
        For each the same as :func:`predict_submap`, or the reason why it failed.
    """
    predictor = _predictor(requests[0][3])
    try:
        if not isinstance(predictor, BatchPredictor):
            raise PredictionError(f"the predictor {predictor.name} takes one submap at a time")
        decoded = [_decoded(task, images, ego_mask) for task, images, ego_mask, _ in requests]
        predictions = predictor.predict_many([(images, hints) for images, hints, _ in decoded])
    except PredictionError as error:
        _log.info("predicting one by one", extra={"reason": str(error)})
        return [_outcome(*request) for request in requests]
    return [
        _encoded(task, prediction, seconds)
        for (task, *_), prediction, (*_, seconds) in zip(requests, predictions, decoded, strict=True)
    ]


def _outcome(
    task: PredictTask, images: Sequence[bytes], ego_mask: bytes | None, config: InferenceConfig
) -> tuple[SubmapGeometry, tuple[bytes, ...]] | str:
    try:
        return predict_submap(task, images, ego_mask, config)
    except PredictionError as error:
        return str(error)


def _decoded(
    task: PredictTask, images: Sequence[bytes], ego_mask: bytes | None
) -> tuple[list[KeyframeImage], PredictionHints, float]:
    """Images and hints of a task, and the seconds that decoding took."""
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
    return decoded, hints, time.perf_counter() - begin


def _encoded(
    task: PredictTask, prediction: Prediction, decode_seconds: float
) -> tuple[SubmapGeometry, tuple[bytes, ...]]:
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


def load_predictor(config: InferenceConfig) -> tuple[str, int]:
    """Import and build the predictor in this process, so that what is missing is said before the first job.

    Returns:
        Which predictor it is and why, in one line: with ``auto`` each worker chooses for its own machine; and the
        number of submaps that it takes together at most.

    Raises:
        ConfigurationError: the predictor is unknown.
        MissingDependencyError: its packages or weights are absent.
    """
    predictor = _predictor(config)
    batch = predictor.batch_limit if isinstance(predictor, BatchPredictor) else 1
    return f"predictor {predictor.name}: {config.predictor_reason or choose_predictor(config)[1]}", batch


@lru_cache(maxsize=1)
def _predictor_of(name: str, config_json: str) -> Predictor:
    # Parallelism comes from workers: two single-threaded ones use two cores best, and one thread repeats bit for bit.
    cv2.setNumThreads(1)
    return create_predictor(name, InferenceConfig.model_validate_json(config_json))


def _predictor(config: InferenceConfig) -> Predictor:
    return _predictor_of(config.predictor, config.model_dump_json())


def _decode_rgb(encoded: bytes, keyframe_id: str) -> npt.NDArray[np.uint8]:
    try:
        return decode_rgb(encoded)
    except CodecError as error:
        raise PredictionError(f"keyframe {keyframe_id} is {error}") from error


def _decode_mask(encoded: bytes, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    mask = None
    with contextlib.suppress(cv2.error):
        mask = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != shape:
        raise PredictionError("the ego mask cannot be decoded, or is not of the size of the images")
    return np.asarray(mask > 0)
