"""The predictor ``recorded``: plays back the geometry that an earlier run left in its ledger (DESIGN 3.4).

For tests and scale runs: registration, pose graph and everything around them with real geometry, but without its cost.
Only reads; the ledger may be in use.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Sequence
from pathlib import Path

from vggt_motion.bus import codec
from vggt_motion.config import InferenceConfig, RecordedConfig
from vggt_motion.errors import ConfigurationError, LedgerError, PredictionError, RequestRefusedError
from vggt_motion.inference.predictor import KeyframeImage, PredictedFrame, Prediction, PredictionHints
from vggt_motion.ledger.directory import DATABASE_NAME, stored_blob
from vggt_motion.ledger.sqlite import read_only
from vggt_motion.records import BlobRef, ScaleKind, Stream, SubmapGeometry, SubmapQuality, SubmapVerdict

_PAGE = 256


def create(config: InferenceConfig) -> RecordedPredictor:
    """The predictor of a configuration.

    Raises:
        ConfigurationError: no ledger is named, or it cannot be read.
    """
    return RecordedPredictor(config.recorded)


class RecordedPredictor:
    """Finds a submap by the ids of its keyframes; holds the records, and reads depth when it is asked for."""

    name = "recorded"

    def __init__(self, config: RecordedConfig) -> None:
        """Read the records of the submap stream.

        Raises:
            ConfigurationError: no ledger is named, or it cannot be read.
        """
        if config.ledger is None:
            raise ConfigurationError("the predictor 'recorded' needs inference.recorded.ledger, the folder of a ledger")
        self._folder: Path = config.ledger
        self._seconds = config.seconds_per_submap
        self._submaps: list[SubmapGeometry] = []
        try:
            with read_only(self._folder / DATABASE_NAME) as reader:
                while rows := reader.records(Stream.SUBMAP.value, len(self._submaps), _PAGE):
                    self._submaps.extend(codec.decode(SubmapGeometry, row.payload) for row in rows)
        except LedgerError as error:
            raise ConfigurationError(f"inference.recorded.ledger: {error}") from error

    def predict(self, images: Sequence[KeyframeImage], hints: PredictionHints) -> Prediction:
        """See :class:`vggt_motion.inference.predictor.Predictor`.

        A part of a recorded submap is found too: its frames are those of the whole.

        Raises:
            PredictionError: a depth payload is missing or damaged.
        """
        begin = time.perf_counter()
        positions = {image.keyframe_id: position for position, image in enumerate(images)}
        submap = self._find(tuple(positions), hints)
        if submap is None:
            reason = f"the recorded run has no submap with the {len(images)} keyframes from {images[0].keyframe_id}"
            return _failed(reason)
        frames = []
        for frame in submap.frames:
            if frame.keyframe_id in positions:
                depth, confidence = codec.decode_depth(self._read(frame.depth))
                position = positions[frame.keyframe_id]
                frames.append(PredictedFrame(position, depth, confidence, frame.intrinsics, frame.submap_from_camera))
        if not frames:
            return _failed(submap.reason or "the recorded submap has none of these keyframes")
        time.sleep(max(0.0, self._seconds - (time.perf_counter() - begin)))
        frames.sort(key=lambda frame: frame.position)
        return Prediction(
            frames=tuple(frames),
            verdict=submap.verdict,
            reason=submap.reason,
            scale_kind=submap.scale_kind,
            model=submap.model,
            quality=submap.quality,
            stage_seconds={"playback": time.perf_counter() - begin},
        )

    def _find(self, keyframe_ids: tuple[str, ...], hints: PredictionHints) -> SubmapGeometry | None:
        """The submap of exactly these keyframes and this hint; else of these keyframes; else one that holds them all.

        Of several, the one of the highest revision.
        """
        wanted = set(keyframe_ids)
        found = [submap for submap in self._submaps if wanted <= set(submap.spec.keyframe_ids)]

        def fit(submap: SubmapGeometry) -> tuple[bool, bool, int]:
            is_exact = submap.spec.keyframe_ids == keyframe_ids
            return is_exact, submap.spec.focal_hint == hints.focal, submap.spec.revision

        return max(found, key=fit, default=None)

    def _read(self, ref: BlobRef) -> bytes:
        try:
            content = stored_blob(self._folder, ref.sha256)
        except (LedgerError, RequestRefusedError) as error:
            raise PredictionError(f"no recorded depth: {error}") from error
        if hashlib.sha256(content).hexdigest() != ref.sha256:
            raise PredictionError(f"the recorded depth {ref.sha256} in {self._folder} is damaged")
        return content


def _failed(reason: str) -> Prediction:
    quality = SubmapQuality(0, math.nan, math.nan, math.nan, math.nan, math.inf)
    return Prediction((), SubmapVerdict.FAILED, reason, ScaleKind.RELATIVE, RecordedPredictor.name, quality, {})
