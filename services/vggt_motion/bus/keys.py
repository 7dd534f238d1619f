"""Every key of the bus, under ``vggt_motion/@v1/{session}/`` (DESIGN section 4).

Chunks that begin with ``@`` are matched by no wildcard, so that neither a foreign ``**`` subscriber nor a careless
query reaches another version of us, or the calls of the ledger.
"""

from __future__ import annotations

import re

from vggt_motion.errors import ConfigurationError

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


class Keys:
    """The keys of one session."""

    def __init__(self, session: str) -> None:
        """Bind the session's name.

        Raises:
            ConfigurationError: the name cannot be part of a key.
        """
        self.session = _checked(session)
        self.prefix = f"vggt_motion/@v1/{session}"

    def image(self, camera: str) -> str:
        """Frames of a camera: foxglove.CompressedImage."""
        return f"{self.prefix}/camera/{_checked(camera)}/image"

    def all_images(self) -> str:
        """Frames of every camera."""
        return f"{self.prefix}/camera/*/image"

    def log(self, stream: str) -> str:
        """Durable records of a stream, published by the ledger: LogEntry."""
        return f"{self.prefix}/log/{_checked(stream)}"

    def all_logs(self) -> str:
        """Durable records of every stream."""
        return f"{self.prefix}/log/*"

    def rpc(self, service: str, call: str) -> str:
        """An acknowledged call: ``@rpc/ledger/append``."""
        return f"{self.prefix}/@rpc/{_checked(service)}/{_checked(call)}"

    def blob(self, sha256: str) -> str:
        """The bytes of one blob."""
        if _SHA256.fullmatch(sha256) is None:
            raise ConfigurationError(f"'{sha256:.80}' is not a SHA-256 in lower-case hexadecimal")
        return f"{self.prefix}/@rpc/ledger/blob/{sha256}"

    def all_blobs(self) -> str:
        """What the ledger serves blobs on; the last chunk of a query's key is the SHA-256."""
        return f"{self.prefix}/@rpc/ledger/blob/*"

    def alive(self, service: str, instance: str) -> str:
        """Liveliness token of one process."""
        return f"{self.prefix}/alive/{_checked(service)}/{_checked(instance)}"

    def all_alive(self, service: str | None = None) -> str:
        """Liveliness tokens of all processes, or of those of one service."""
        return f"{self.prefix}/alive/{'*' if service is None else _checked(service)}/*"

    def health(self, service: str, instance: str) -> str:
        """Health of one process, once a second: HealthReport."""
        return f"{self.prefix}/health/{_checked(service)}/{_checked(instance)}"

    def all_health(self, service: str | None = None) -> str:
        """Health of all processes, or of those of one service."""
        return f"{self.prefix}/health/{'*' if service is None else _checked(service)}/*"


def service_of(key: str) -> tuple[str, str]:
    """Service and instance of an ``alive`` or ``health`` key."""
    _, service, instance = key.rsplit("/", 2)
    return service, instance


def last_chunk(key: str) -> str:
    """The last chunk of a key: a blob's SHA-256, a stream's name."""
    return key.rsplit("/", 1)[-1]


def _checked(name: str) -> str:
    if _NAME.fullmatch(name) is None:
        raise ConfigurationError(f"'{name:.80}' cannot be part of a key: use letters, digits, '_', '.' and '-'")
    return name
