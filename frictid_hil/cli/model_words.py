"""``gap diagnose --model``: its options as values, its result as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frictid_hil.cli.output import Output, Result
from frictid_hil.cli.tables import folding
from frictid_hil.errors import UsageError
from frictid_hil.units import parse_quantity

if TYPE_CHECKING:
    from frictid_hil.jobs.gap.from_model import ModelLogs


def model_logs(
    model: Path,
    logs: Sequence[Path],
    joints: Sequence[str] | None,
    columns: str | None,
    hold: Sequence[str] | None,
    tolerance: Sequence[str] | None,
    validation: Sequence[str] | None,
    split: str,
    nominal: Path | None,
    profile: Path | None,
    mujoco: Path | None,
) -> ModelLogs:
    """The options as one value.

    Raises:
        UsageError: one that cannot be read, or that does not go with a model.
    """
    from frictid_hil.jobs.gap.from_model import ModelLogs

    for name, given in (("--profile", profile), ("--export-mujoco", mujoco)):
        if given is not None:
            raise UsageError(
                f"{name} does not go with --model",
                next_step="the model brings its own friction; --write-model writes the improved model",
            )
    return ModelLogs(
        model=model,
        logs=logs,
        joints=joints or (),
        columns=columns,
        held=dict(_held(word) for word in hold or ()),
        tolerances=dict(_tolerance(word) for word in tolerance or ()),
        validation=validation or (),
        split=split,
        nominal=nominal,
    )


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
    table = folding("joint", "verdict", "cause", "confidence", "gap before", "after", "noise floor", whole=("joint",))
    for name, joint in result["joints"].items():
        causes = joint["causes"]
        gap = [joint["gap"][state]["inverse_nm"] for state in ("before", "after", "noise_floor")]
        table.add_row(
            name,
            joint["verdict"],
            ", ".join(cause["effect"] for cause in causes),
            ", ".join(f"{cause['confidence']:.2f}" for cause in causes),
            *("-" if value is None else f"{value:.3g} {_units(joint)[0]}" for value in gap),
        )
    output.out.print(table)
    output.out.print(result["summary"], soft_wrap=True)
    _print_arm_cause(output, result)
    _print_export(output, result)
    for line, names in _same_lines(result["joints"]).items():
        who = "all joints" if len(names) == len(result["joints"]) > 1 else ", ".join(names)
        output.out.print(f"{who}: {line}", soft_wrap=True)
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


def _print_export(output: Output, result: Result) -> None:
    """The user's simulator before and after, and what was written where."""
    from frictid_hil.jobs.gap.nearer import left_out_words

    loop = result["closed_loop"]
    if "reason" in loop:
        output.out.print(f"closed loop of your model: {loop['reason']}", soft_wrap=True)
    else:
        table = folding("your model in MuJoCo", "torque before", "after", "position before", "after")
        for name, before in loop["before"].items():
            states = (before, loop["after"][name])
            torque, length = _units(result["joints"].get(name, {}))
            torques = ["-" if s["torque_nm"] is None else f"{s['torque_nm']:.3g} {torque}" for s in states]
            table.add_row(name, *torques, *(f"{1e3 * s['position_rad']:.3g} m{length}" for s in states))
        output.out.print(table)
        for line in left_out_words(loop):
            output.out.print(line, soft_wrap=True)
    for name, joint in result.get("export", {}).get("joints", {}).items():
        off = joint["torque_difference_percent"]
        how = (
            "chosen by the positions that were fitted"
            if off is None
            else f"{off:.2f} % of torque from our simulation on withheld motion"
        )
        output.out.print(f"{name}: the export is {how}")
        for effect, where in joint["placed"].items():
            output.out.print(f"  {effect}: {where}", soft_wrap=True)
        for effect, why in joint["lost"].items():
            output.out.print(f"  lost of {effect}: {why}", soft_wrap=True)
    for remark in {r for joint in result.get("export", {}).get("joints", {}).values() for r in joint["remarks"]}:
        output.out.print(remark, soft_wrap=True)
    if result.get("model"):
        output.out.print(f"model: {result['model']}", soft_wrap=True)
    for target, told in result.get("targets", {}).items():
        output.out.print(f"{target}: {', '.join(told['files'])}", soft_wrap=True)
    _print_figures(output, result)
    if result.get("report"):
        output.out.print(f"report: {result['report']}", soft_wrap=True)
    if result.get("model_refused"):
        output.out.print(f"no model was written: {result['model_refused']}", soft_wrap=True)


def _print_figures(output: Output, result: Result) -> None:
    """How near every file comes to the machine: one row a file and engine."""
    from frictid_hil.jobs.gap.export_figures import rows_of

    if not (rows := rows_of(result)):
        return
    table = folding("export", "where it ran", "torque error before", "after", "what is lost", whole=("export",))
    for row in rows:
        table.add_row(*row)
    output.out.print(table)
    output.out.print(
        "torque error: of the measured torque of the changed joints, on motion that was not fitted", soft_wrap=True
    )


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
