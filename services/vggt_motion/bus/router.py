"""The service ``router``: a Zenoh router in this Python process (DESIGN section 4).

The wheel of Zenoh brings no ``zenohd``, but a session in router mode routes. Containers may run the official image.
"""

from __future__ import annotations

import logging

from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.config import Config

_log = logging.getLogger(__name__)


def main(config: Config) -> int:
    """Listen on ``bus.endpoint`` and route until told to stop; it is ready when it can be connected to.

    Returns:
        Exit code; 2 if the endpoint cannot be listened on, with one line that says why.
    """
    return run_service("router", config, _route, mode="router")


def _route(context: ServiceContext) -> None:
    context.set_health("working", f"routing at {context.config.bus.endpoint}")
    context.stopping.wait()
