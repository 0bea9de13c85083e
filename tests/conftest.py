"""Every test process lives in folders of its own: locks, sockets, state and data of other runs are out of reach."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
from pathlib import Path

from hypothesis import HealthCheck, settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded
_home = tempfile.mkdtemp(prefix="frictid-tests-")
for _name in ("FRICTID_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_DATA_HOME"):
    os.environ[_name] = f"{_home}/{_name.lower()}"
    Path(os.environ[_name]).mkdir()

# In the background of a script, or behind ``nohup``, signals are ignored, and so they are in the runs that tests stop.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

# How long a busy computer takes says nothing of what is tested.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")
settings.register_profile(
    "fast", settings.get_profile("patient"), max_examples=20
)  # the developer's loop; the whole check draws as many as tests say
