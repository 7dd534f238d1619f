from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ledger_helpers import damage_blob
from synthetic_session import Session
from vggt_motion.bus import codec
from vggt_motion.bus.ledger import append_request
from vggt_motion.config import Config, InferenceConfig, RecordedConfig
from vggt_motion.errors import ConfigurationError, PredictionError
from vggt_motion.inference.predictor import KeyframeImage, PredictionHints
from vggt_motion.inference.registry import create_predictor
from vggt_motion.ledger.service import Desk, open_session
from vggt_motion.records import FocalHint, Stream, SubmapVerdict

PIXELS = np.zeros((4, 4, 3), np.uint8)


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """A synthetic session whose submaps are in the ledger at ``tmp_path``."""
    made = Session(3)
    ledger = open_session(tmp_path, Config().ledger.model_copy(update={"reserve_bytes": 0}))
    desk = Desk(ledger, lambda: None)
    for submap in made.submaps:
        blobs = [made.blobs[ref.sha256] for ref in codec.blob_refs(submap)]
        request = append_request(Stream.SUBMAP, submap.record_id, submap, blobs)
        (outcome,) = desk.append([codec.encode(request)])
        assert isinstance(outcome, bytes), outcome
    ledger.close()
    return made


def config(folder: Path | None) -> InferenceConfig:
    return InferenceConfig(predictor="recorded", recorded=RecordedConfig(ledger=folder))


def images(ids: tuple[str, ...]) -> list[KeyframeImage]:
    return [KeyframeImage(keyframe_id, 0, PIXELS) for keyframe_id in ids]


def test_a_submap_comes_back_as_it_was_recorded(session: Session, tmp_path: Path) -> None:
    recorded = session.submaps[2]
    ids = recorded.spec.keyframe_ids
    prediction = create_predictor("recorded", config(tmp_path)).predict(images(ids), PredictionHints())
    assert (prediction.verdict, prediction.model) == (recorded.verdict, recorded.model)
    assert prediction.quality == recorded.quality
    assert [ids[frame.position] for frame in prediction.frames] == [frame.keyframe_id for frame in recorded.frames]
    for frame, was in zip(prediction.frames, recorded.frames, strict=True):
        np.testing.assert_array_equal(frame.submap_from_camera, was.submap_from_camera)
        # The same payload again, so that a run with it refers to the same blobs.
        assert codec.encode_depth(frame.depth, frame.confidence) == session.blobs[was.depth.sha256]


def test_a_half_of_a_submap_is_played_back_from_the_whole(session: Session, tmp_path: Path) -> None:
    ids = session.submaps[1].spec.base_keyframe_ids[1:3]
    hints = PredictionHints(focal=FocalHint(0.5, 0.1))
    prediction = create_predictor("recorded", config(tmp_path)).predict(images(ids), hints)
    assert [frame.position for frame in prediction.frames] == [0, 1]


def test_unknown_keyframes_are_a_failed_submap(session: Session, tmp_path: Path) -> None:
    prediction = create_predictor("recorded", config(tmp_path)).predict(
        images(("other/0/00000000",)), PredictionHints()
    )
    assert prediction.verdict is SubmapVerdict.FAILED and not prediction.frames
    assert "other/0/00000000" in prediction.reason


def test_a_damaged_payload_is_an_error(session: Session, tmp_path: Path) -> None:
    submap = session.submaps[0]
    sha256 = submap.frames[0].depth.sha256
    damage_blob(tmp_path, sha256, b"rotten")
    predictor = create_predictor("recorded", config(tmp_path))
    with pytest.raises(PredictionError, match="damaged"):
        predictor.predict(images(submap.spec.keyframe_ids), PredictionHints())


@pytest.mark.parametrize("folder", [None, "empty"])
def test_without_a_ledger_the_configuration_is_refused(folder: str | None, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="ledger"):
        create_predictor("recorded", config(None if folder is None else tmp_path / folder))
