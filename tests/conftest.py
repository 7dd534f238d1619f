"""Shared fixtures: where the evaluation data is, and the sample that the repository ships."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

REPOSITORY = Path(__file__).resolve().parents[1]
DATA_VARIABLE = "VGGT_MOTION_DATA"

# No timed assertions: a busy machine is not a defect.
settings.register_profile("vggt_motion", deadline=None)
settings.load_profile("vggt_motion")


def evaluation_data() -> Path:
    """Folder with the evaluation sequences; may not exist."""
    return Path(os.environ.get(DATA_VARIABLE, REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Evaluation data, or a skip that says how to provide it."""
    directory = evaluation_data()
    if not directory.is_dir():
        pytest.skip(f"no evaluation data at {directory}: set {DATA_VARIABLE}")
    return directory


@pytest.fixture(scope="session")
def sample_dir() -> Path:
    """The data that the repository ships."""
    return REPOSITORY / "tests" / "data"
