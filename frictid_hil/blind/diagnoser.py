"""The diagnosing process of the blind check: it sees experiment sets, and nothing else of the check.

Started with the folder of cases as its working directory. Reads one request a line, ``{"case", "left_out"}``, writes
one answer a line; its seconds are those of the processor. It neither imports the generator nor learns the seed.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any, TextIO


def serve(requests: TextIO, answers: TextIO) -> None:
    """Answer every request until the requests end."""
    # Imported here so that the process reports its import failure as any other.
    from frictid_hil.gap.diagnose import diagnose
    from frictid_hil.gap.experiment_set import ExperimentSet
    from frictid_hil.simulation.effects import all_effects

    for line in requests:
        request = json.loads(line)
        started = time.process_time()
        answer: dict[str, Any] = {"case": request["case"]}
        try:
            left_out = request["left_out"]
            library = [name for name in all_effects() if name != left_out] if left_out else None
            answer["diagnosis"] = diagnose(ExperimentSet.load(Path(request["case"])), library=library).to_json()
        except Exception as error:  # an answer that raises is a wrong answer, and the check goes on
            answer["error"] = f"{type(error).__name__}: {error}"
        answer["seconds"] = time.process_time() - started
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    serve(sys.stdin, sys.stdout)
