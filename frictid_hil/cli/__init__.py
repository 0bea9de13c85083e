"""The command line: parse, call a job, print. No logic lives here."""

import os

# Our matrices are small: threads of the linear algebra only wait for each other, five times as long on a busy computer.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
