"""Every test process lives in folders of its own: locks, sockets, state and data of other runs are out of reach."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded
_home = tempfile.mkdtemp(prefix="frictid-tests-")
for _name in ("FRICTID_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_DATA_HOME"):
    os.environ[_name] = f"{_home}/{_name.lower()}"
    Path(os.environ[_name]).mkdir()

settings.register_profile("fast", max_examples=20)  # the developer's loop; the whole check draws as many as tests say
