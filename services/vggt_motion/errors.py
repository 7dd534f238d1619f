"""The exceptions of the project, under one root.

Every entry point (command line, HTTP, bus) turns a :class:`VggtMotionError` into one clear line and, on the command
line, into the exit code that the class carries (DESIGN section 5). Anything else that escapes is a defect of ours.
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar


class VggtMotionError(Exception):
    """Root of all errors that the project raises on purpose; ``str(error)`` is one line that a user can act on."""

    exit_code: ClassVar[int] = 1


class InputError(VggtMotionError):
    """The input (file, folder, argument) is such that no trajectory can be made from it."""

    exit_code: ClassVar[int] = 2


class ConfigurationError(InputError):
    """A configuration value is unknown, malformed or contradicts another one."""


class SourceError(InputError):
    """A frame source cannot be opened, or cannot deliver a single readable frame."""


class SourceTruncatedError(VggtMotionError):
    """The source ended early (truncated file, size change in mid-stream); what was read before is kept."""

    exit_code: ClassVar[int] = 3


class MissingDependencyError(InputError):
    """A chosen part needs a package that is not installed; the message says which one and how to get it."""


class BusError(VggtMotionError):
    """The bus could not carry out a request."""


class BusUnavailableError(BusError):
    """No reply: the other side or the link is down. Safe to repeat: all our requests are idempotent."""


class RefusalCode(StrEnum):
    """Why a request was refused; travels in every error reply (``Refusal`` of the wire contract)."""

    INVALID = "invalid"  # malformed, out of bounds, or of an unknown schema
    CONFLICT = "conflict"  # the id is known with another content
    DISK_FULL = "disk_full"  # below the reserve; raised as DiskFullError
    UNKNOWN = "unknown"  # what was asked for does not exist
    GONE = "gone"  # it existed and is no longer valid
    UNAVAILABLE = "unavailable"  # stopping or overloaded; raised as BusUnavailableError
    INTERNAL = "internal"  # a defect on the answering side; it is in its log


class RequestRefusedError(BusError):
    """The other side understood the request and refused it; repeating it unchanged is useless."""

    def __init__(self, message: str, code: RefusalCode = RefusalCode.INVALID) -> None:
        super().__init__(message)
        self.code = code


class CodecError(BusError):
    """Bytes that are not what their type says: malformed, truncated, of another schema or out of bounds."""


class LedgerError(VggtMotionError):
    """The ledger's store is damaged, locked by another process or of another schema version."""


class DiskFullError(LedgerError):
    """New data is refused until there is space on the disk again; nothing that was acknowledged is affected."""


class PredictionError(VggtMotionError):
    """A submap could not be predicted; the message is the reason that the status and the report show."""


class RegistrationError(VggtMotionError):
    """Point maps from which no trustworthy similarity transform can be estimated; the message names the degeneracy."""


class OptimizationError(VggtMotionError):
    """The pose graph could not be solved."""
