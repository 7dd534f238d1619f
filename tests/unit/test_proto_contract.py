"""The wire contract: generated code is fresh, the style is buf's, and messages mirror the records field by field."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import typing
from dataclasses import fields
from enum import StrEnum
from pathlib import Path
from types import ModuleType

import pytest
from google.protobuf.descriptor import EnumDescriptor

from vggt_motion import errors, records
from vggt_motion.v1 import constraint_pb2, event_pb2, jobs_pb2, keyframe_pb2, ledger_pb2, segment_pb2, submap_pb2

REPOSITORY = Path(__file__).resolve().parents[2]


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("proto_generate", REPOSITORY / "proto" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_regenerating_gives_no_difference() -> None:
    pytest.importorskip("grpc_tools", reason="grpcio-tools is not installed (extra dev)")
    assert _generator().differences() == []


def test_a_stale_file_is_noticed(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools", reason="grpcio-tools is not installed (extra dev)")
    generator = _generator()
    generator.generate(tmp_path)
    target = tmp_path / "vggt_motion" / "v1" / "graph_pb2.py"
    target.write_text(target.read_text() + "# edited\n")
    (tmp_path / "vggt_motion" / "v1" / "gone_pb2.py").write_text("")
    assert generator.differences(tmp_path) == ["gone_pb2.py", "graph_pb2.py"]


def test_buf_lint_is_clean() -> None:
    buf = shutil.which("buf", path=f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin")
    if buf is None:
        pytest.skip("buf is not installed (buf-bin, extra dev)")
    for arguments in (["lint"], ["format", "--diff", "--exit-code"]):
        result = subprocess.run(
            [buf, *arguments], cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=False
        )
        assert result.returncode == 0, result.stdout + result.stderr


ENUMS: list[tuple[type[StrEnum], EnumDescriptor]] = [
    (records.MotionState, keyframe_pb2.MotionState.DESCRIPTOR),
    (records.DropReason, segment_pb2.DropReason.DESCRIPTOR),
    (records.ScaleKind, submap_pb2.ScaleKind.DESCRIPTOR),
    (records.SubmapPart, submap_pb2.SubmapPart.DESCRIPTOR),
    (records.SubmapVerdict, submap_pb2.SubmapVerdict.DESCRIPTOR),
    (records.DepthCodec, submap_pb2.DepthCodec.DESCRIPTOR),
    (records.ConstraintKind, constraint_pb2.ConstraintKind.DESCRIPTOR),
    (records.EventKind, event_pb2.EventKind.DESCRIPTOR),
    (records.JobKind, jobs_pb2.JobKind.DESCRIPTOR),
    (records.JobState, jobs_pb2.JobState.DESCRIPTOR),
    (records.DoneOutcome, jobs_pb2.DoneOutcome.DESCRIPTOR),
    (errors.RefusalCode, ledger_pb2.RefusalCode.DESCRIPTOR),
]


@pytest.mark.parametrize(("ours", "wire"), ENUMS, ids=lambda value: getattr(value, "name", None) or value.__name__)
def test_enums_have_the_same_members_and_a_zero_unspecified(ours: type[StrEnum], wire: EnumDescriptor) -> None:
    prefix = "".join(f"_{c}" if c.isupper() else c for c in wire.name).upper().lstrip("_") + "_"
    assert wire.values_by_number[0].name == f"{prefix}UNSPECIFIED"
    assert {f"{prefix}{member.name}" for member in ours} == {value.name for value in wire.values if value.number != 0}


MIRRORED = [
    (records.Keyframe, keyframe_pb2.Keyframe),
    (records.FrameEntry, segment_pb2.FrameEntry),
    (records.Segment, segment_pb2.Segment),
    (records.FocalHint, submap_pb2.FocalHint),
    (records.SubmapSpec, submap_pb2.SubmapSpec),
    (records.FrameGeometry, submap_pb2.FrameGeometry),
    (records.SubmapQuality, submap_pb2.SubmapQuality),
    (records.SubmapGeometry, submap_pb2.SubmapGeometry),
    (records.RegistrationSpec, constraint_pb2.RegistrationSpec),
    (records.RegistrationAttempt, constraint_pb2.RegistrationAttempt),
    (records.Constraint, constraint_pb2.Constraint),
    (records.Event, event_pb2.Event),
    (records.Job, jobs_pb2.Job),
    (records.Lease, jobs_pb2.Lease),
    (records.JobReport, jobs_pb2.JobReport),
    (records.LogEntry, ledger_pb2.LogEntry),
    (records.LedgerStatus, ledger_pb2.LedgerStatus),
]


@pytest.mark.parametrize(("record", "message"), MIRRORED, ids=lambda value: value.__name__)
def test_every_field_of_a_record_is_on_the_wire_and_back(record: type, message: type) -> None:
    wire = {field.name for field in typing.cast("typing.Any", message).DESCRIPTOR.fields} - {"schema_version"}
    assert {field.name for field in fields(record)} == wire
