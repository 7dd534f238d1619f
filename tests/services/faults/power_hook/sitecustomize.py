"""Found by every Python process of a run under test: the one that serves the ledger writes down what its disk does."""

import os
import sys
from pathlib import Path

_line = sys.orig_argv
_file = os.environ.get("VGGT_MOTION_TEST_POWER_LOG")
if _file and "serve" in _line and _line[_line.index("serve") + 1] == "ledger" and not Path(_file).exists():
    from power_loss import CUT_VARIABLE, DiskLog

    _directory = Path(_line[_line.index("--directory") + 1])
    DiskLog(_directory, file=Path(_file), cut_at_sync=int(os.environ[CUT_VARIABLE])).install()
