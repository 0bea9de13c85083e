import pickle

import pytest

from frictid_hil import errors


def branches() -> list[type[errors.FrictidError]]:
    found, queue = [], [errors.FrictidError]
    while queue:
        kind = queue.pop()
        found.append(kind)
        queue.extend(kind.__subclasses__())
    return [kind for kind in found if kind.__module__ == errors.__name__ and kind is not errors.InvalidFields]


@pytest.mark.parametrize("kind", branches())
def test_errors_cross_process_borders_whole(kind: type[errors.FrictidError]) -> None:
    error = kind("what", where="where", cause="cause", next_step="next")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.what, again.where, again.cause, again.next_step) == ("what", "where", "cause", "next")


def test_exit_codes_are_those_of_the_design() -> None:
    codes = {kind.__name__: kind.exit_code for kind in branches()}
    assert codes["FrictidError"] == codes["IdentificationError"] == 1
    assert codes["UsageError"] == codes["ConfigError"] == codes["InputFileError"] == codes["PlanRefused"] == 2
    assert codes["HardwareError"] == codes["HardwareBusy"] == 3
    assert codes["SafetyAbort"] == 4
    assert codes["GateFailed"] == 5
    assert codes["Interrupted"] == 130


def test_invalid_fields_name_every_field() -> None:
    problems = [errors.FieldProblem(("joints", "1", "node"), "missing"), errors.FieldProblem((), "empty")]
    again = pickle.loads(pickle.dumps(errors.InvalidFields(problems)))
    assert "joints.1.node: missing" in str(again)
    assert again.problems == problems
