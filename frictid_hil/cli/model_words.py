"""``gap diagnose --model``: its options as values, its result as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frictid_hil.cli.output import Output, Result
from frictid_hil.errors import UsageError
from frictid_hil.units import parse_quantity

if TYPE_CHECKING:
    from frictid_hil.jobs.gap.from_model import ModelLogs


def model_logs(output: Output, logs: Sequence[Path]) -> ModelLogs:
    """The options as one value.

    Raises:
        UsageError: one that cannot be read, or that does not go with a model.
    """
    from frictid_hil.jobs.gap.from_model import ModelLogs

    given = output.given
    for name, value in (("--profile", given["profile"]), ("--export-mujoco", given["mujoco"])):
        if value is not None:
            raise UsageError(
                f"{name} does not go with --model",
                next_step="the model brings its own friction; --write-model writes the improved model",
            )
    held = dict(_held(word) for word in given["hold"] or ())
    tolerances = dict(_tolerance(word) for word in given["tolerance"] or ())
    return output.options(ModelLogs, logs=logs, joints=given["joint"], held=held, tolerances=tolerances)


def _held(word: str) -> tuple[str, float]:
    name, equals, value = word.partition("=")
    if not equals:
        raise UsageError(f"--hold {word}: no place is given", next_step="write it as --hold elbow=20deg")
    length = value.strip().endswith("m")
    return name, parse_quantity(value, "length" if length else "angle")


def _tolerance(word: str) -> tuple[str, float | str]:
    name, equals, value = word.partition("=")
    if value in ("data_sheet", "cad", "profile"):
        return name, value
    try:
        share = float(value.removesuffix("%")) * (0.01 if value.endswith("%") else 1.0)
    except ValueError:
        share = -1.0
    if not equals or not share >= 0.0:
        raise UsageError(
            f"--tolerance {word} is no one-sigma", next_step="write it as --tolerance inertia_kg_m2=5% (or =cad)"
        )
    return name, share


def print_arm(output: Output, result: Result) -> None:
    """Joints as rows, then the arm."""
    rows = []
    for name, joint in result["joints"].items():
        causes = joint["causes"]
        gap = [joint["gap"][state]["inverse_nm"] for state in ("before", "after", "noise_floor")]
        words = ("effect", "{}"), ("confidence", "{:.2f}")
        told = (", ".join(form.format(cause[key]) for cause in causes) for key, form in words)
        unit = _units(joint)[0]
        rows.append((name, joint["verdict"], *told, *("-" if v is None else f"{v:.3g} {unit}" for v in gap)))
    headings = ("joint", "verdict", "cause", "confidence", "gap before", "after", "noise floor")
    output.table(headings, rows, ("joint",))
    output.say(result["summary"])
    _print_arm_cause(output, result)
    _print_closed_loop(output, result)
    _print_written(output, result)
    for line, names in _same_lines(result["joints"]).items():
        who = "all joints" if len(names) == len(result["joints"]) > 1 else ", ".join(names)
        output.say(f"{who}: {line}")
    for name in result["still"]:
        output.out.print(f"{name}: stands still in every log, so nothing can be said of it")
    for name, place in result["held"].items():
        output.out.print(f"{name}: held at {place:.4g}")


def _print_arm_cause(output: Output, result: Result) -> None:
    """What belongs to no single joint, and how much these motions can tell."""
    arm = result["arm"]
    if arm is None:
        return
    if cause := arm["cause"]:
        for name, value in cause["parameters"].items():
            low, high = value["interval_95"]
            output.out.print(f"  {name} = {value['value']:.4g} ({low:.4g} .. {high:.4g})")
    base = arm["base_parameters"]
    output.out.print(
        f"the motions tell {base['rank']} combinations of {base['of']} inertial parameters apart (condition "
        f"{base['condition']:.0f})",
    )


def _print_closed_loop(output: Output, result: Result) -> None:
    """The user's simulator before and after."""
    from frictid_hil.jobs.gap.nearer import left_out_words

    loop = result["closed_loop"]
    if "reason" in loop:
        output.say(f"closed loop of your model: {loop['reason']}")
        return
    rows = []
    for name, before in loop["before"].items():
        states = (before, loop["after"][name])
        torque, length = _units(result["joints"].get(name, {}))
        torques = ["-" if s["torque_nm"] is None else f"{s['torque_nm']:.3g} {torque}" for s in states]
        rows.append((name, *torques, *(f"{1e3 * s['position_rad']:.3g} m{length}" for s in states)))
    output.table(("your model in MuJoCo", "torque before", "after", "position before", "after"), rows)
    for line in left_out_words(loop):
        output.say(line)


def _print_written(output: Output, result: Result) -> None:
    """What was written where, and how near every file comes to the machine: one row a file and engine."""
    from frictid_hil.jobs.gap.export_figures import rows_of

    joints = result.get("export", {}).get("joints", {})
    for name, joint in joints.items():
        off = joint["torque_difference_percent"]
        how = (
            "chosen by the positions that were fitted"
            if off is None
            else f"{off:.2f} % of torque from our simulation on withheld motion"
        )
        output.out.print(f"{name}: the export is {how}")
        for effect, where in joint["placed"].items():
            output.say(f"  {effect}: {where}")
        for effect, why in joint["lost"].items():
            output.say(f"  lost of {effect}: {why}")
    for remark in {remark for joint in joints.values() for remark in joint["remarks"]}:
        output.say(remark)
    output.tell(result, "model")
    for target, told in result.get("targets", {}).items():
        output.say(f"{target}: {', '.join(told['files'])}")
    if rows := rows_of(result):
        headings = ("export", "where it ran", "torque error before", "after", "what is lost")
        output.table(headings, rows, ("export",))
        output.say("torque error: of the measured torque of the changed joints, on motion that was not fitted")
    output.tell(result, "report")
    if result.get("model_refused"):
        output.say(f"no model was written: {result['model_refused']}")


def _units(joint: Mapping[str, Any]) -> tuple[str, str]:
    """(of torque or force, of position)."""
    return ("N", "m") if joint.get("prismatic") else ("N m", "rad")


def _same_lines(joints: Mapping[str, Any]) -> dict[str, list[str]]:
    """What is asked and what could not be concluded, each line once, with the joints that it is about."""
    found: dict[str, list[str]] = {}
    for name, joint in joints.items():
        for line in (*joint["asked"], *(f"{subject}: {why}" for subject, why in joint["reasons"].items())):
            found.setdefault(line, []).append(name)
    return found
