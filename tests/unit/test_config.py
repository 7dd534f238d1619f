from __future__ import annotations

from pathlib import Path

import pytest

from vggt_motion.config import Config, load_config
from vggt_motion.errors import ConfigurationError


def test_dumped_configuration_reads_back_equal(tmp_path: Path) -> None:
    config = load_config(assignments=["frontend.max_keyframes=10", "registration.min_inlier_ratio=1e-1"])
    assert config.frontend.max_keyframes == 10
    assert config.registration.min_inlier_ratio == pytest.approx(0.1)
    file = tmp_path / "config.yaml"
    file.write_text(config.to_yaml())
    assert load_config(file) == config


def test_command_line_beats_environment_beats_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("frontend: {max_keyframes: 8, overlap_keyframes: 4, parallax_px: 11}\n")
    monkeypatch.setenv("VGGT_MOTION_FRONTEND__MAX_KEYFRAMES", "9")
    monkeypatch.setenv("VGGT_MOTION_FRONTEND__OVERLAP_KEYFRAMES", "3")
    config = load_config(file, ["frontend.overlap_keyframes=2"])
    assert (config.frontend.max_keyframes, config.frontend.overlap_keyframes, config.frontend.parallax_px) == (9, 2, 11)


def test_the_token_is_never_dumped() -> None:
    config = load_config(assignments=["gateway.token=0123456789abcdef0123"])
    assert "0123456789abcdef0123" not in config.to_yaml()


@pytest.mark.parametrize(
    ("assignment", "place"),
    [
        ("frontend.nonsense=1", "frontend.nonsense"),
        ("frontend.max_keyframes=many", "frontend.max_keyframes"),
        ("frontend.max_keyframes=3", "frontend"),
        ("nonsense=1", "nonsense"),
        ("frontend", "section.field=value"),
        ("frontend.max_keyframes.deeper=1", "frontend.max_keyframes"),
        ("frontend.max_keyframes=[", "not a value"),
    ],
)
def test_bad_assignment_is_one_clear_line(assignment: str, place: str) -> None:
    with pytest.raises(ConfigurationError, match=place.replace(".", r"\.")) as caught:
        load_config(assignments=[assignment])
    assert "\n" not in str(caught.value)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot read"):
        load_config(tmp_path / "absent.yaml")
    for text in ("- a\n- b\n", "a: [", "\x00"):
        file = tmp_path / "bad.yaml"
        file.write_text(text)
        with pytest.raises(ConfigurationError):
            load_config(file)


def test_configuration_is_frozen() -> None:
    config = Config()
    with pytest.raises(Exception, match="frozen"):
        config.frontend.max_keyframes = 3  # type: ignore[misc]
