"""A frontend that takes its time: on PYTHONPATH of the processes under test, seconds a frame in PACE_S_PER_FRAME."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

_seconds = float(os.environ.get("PACE_S_PER_FRAME", "0"))

if _seconds and {"serve", "frontend"} <= set(sys.orig_argv):
    from vggt_motion.frontend.pipeline import FrontendPipeline

    _push = FrontendPipeline.push

    def _paced(self: FrontendPipeline, frame: Any) -> Any:
        time.sleep(_seconds)
        return _push(self, frame)

    FrontendPipeline.push = _paced  # type: ignore[method-assign]
