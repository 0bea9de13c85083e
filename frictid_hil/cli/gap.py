"""``gap``: record diagnostic experiments, find where the sim-to-real gap lies and why, check the diagnosis itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import Output, Result, Told, takes, verb
from frictid_hil.errors import UsageError
from frictid_hil.units import parse_quantity

if TYPE_CHECKING:
    from frictid_hil.jobs.gap.from_model import ModelLogs


def model_logs(output: Output, logs: Sequence[Path]) -> ModelLogs:
    """The options as one value (``UsageError``: one that cannot be read, or that does not go with a model)."""
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
    from frictid_hil.jobs.gap.write_model import left_out_words

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
    from frictid_hil.jobs.gap.exports import rows_of

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


app = typer.Typer(
    help="Where the simulator differs from the machine, why, and how far it closes.", no_args_is_help=True
)


def _show_diagnosis(output: Output, result: Result) -> None:
    if "model_in" in result:
        print_arm(output, result)
        return
    output.out.print(result["summary"], style="bold")
    if causes := [_cause(cause) for cause in result["causes"]]:
        output.table(("cause", "confidence", "closes", "parameters", "confusable with"), causes, ("cause", "closes"))
    if along := result["fitted_along"]:
        told = "; ".join(f"{effect} {_numbers(values)}" for effect, values in along.items())
        output.out.print(f"fitted beside them, within tolerances: {told}")
    shares = [(region, region["share_of_gap"]) for region in result["where"]]
    where = [(r["region"], f"{100 * s:.0f} %", "█" * round(30 * s), r["description"]) for r, s in shares if s >= 0.005]
    output.table(("where", "share of gap", "", ""), where, ("where",))
    _print_gap(output, result["gap"])
    if asked := result.get("next_experiment"):
        output.out.print(f"record next ({asked['duration_s']:.0f} s): {asked['description']}")
    for subject, why in result["reasons"].items():
        output.out.print(f"{subject}: {why}")
    if keys := result.get("not_read"):
        output.out.print(f"nominal.yaml: nothing reads {', '.join(keys)}")
    if exported := result.get("mujoco"):
        output.say(f"mujoco: {exported['model']} and {exported['callback_script']}")
        for lost in exported["lost"]:
            output.out.print(f"  lost: {lost}")
    output.tell(result, "model", "report")
    if result.get("model_refused"):
        output.say(f"no model was written: {result['model_refused']}")


def _print_gap(output: Output, gap: Result) -> None:
    """How far it closes, and what the low-pass has taken away before."""
    rows = []
    for name, interval in gap["after_interval_95"].items():
        before, after, floor = (gap[state][name] for state in ("before", "after", "noise_floor"))
        told = ["-" if value is None else f"{value:.4g}" for value in (before, after, floor)]
        if interval is not None:
            told[1] += f" ({interval[0]:.4g} .. {interval[1]:.4g})"
        rows.append((name, *told))
    output.table(("on validation logs", "before", "after (95 % interval)", "noise floor"), rows)
    if gap["raw"] is not None:
        raw, high_hz = gap["raw"], gap["band"]["high_hz"]
        output.out.print(
            f"behind a low-pass at {high_hz:.3g} Hz; before it inverse_nm is {raw['inverse_nm']:.4g}, of which noise "
            f"makes {raw['noise_floor']['inverse_nm']:.4g}"
        )


def _numbers(values: Result) -> str:
    return ", ".join(
        f"{name} = {value['value']:.4g}" if isinstance(value, dict) else f"{name} = {value:.4g}"
        for name, value in values.items()
    )


def _cause(cause: Result) -> tuple[str, ...]:
    closed = "" if cause["gap_closed_percent"] is None else f"{cause['gap_closed_percent']:.0f} %"
    return (
        cause["effect"],
        f"{cause['confidence']:.2f}",
        closed,
        _numbers(cause["parameters"]),
        ", ".join(cause["confusable_with"]),
    )


@verb(app, "diagnose", _show_diagnosis, schema="gap_diagnose")
@takes(
    logs=argument("[SET | LOG...]", "Folder with nominal.yaml and its logs; or recordings that lie anywhere."),
    model=option("--model", "FILE", "Your own robot model, MJCF or URDF: every joint is diagnosed."),
    more_logs=option("--log", "LOG", "A recording; as those without an option."),
    columns=option("--columns", "FILE", "Column map of a foreign logger (emps.yaml)."),
    nominal=option("--nominal", "FILE", "What the simulator believes (nominal.yaml)."),
    profile=option("--profile", "PROFILE", "Friction profile that the simulator believes."),
    joint=option(
        "--joint -j",
        "JOINT",
        "The joint, where logs or profile hold several; of a model several times, or NAME=NAME_IN_LOG.",
    ),
    hold=option("--hold", "JOINT=20deg", "Where a joint of the model stood that no log has."),
    tolerance=option(
        "--tolerance",
        "NUMBER=SIGMA",
        "One-sigma of a number of the model, relative or data_sheet, cad, profile; JOINT:NUMBER=... for one.",
    ),
    executor=option("--executor", "WHERE", "processes:N, or dask://host:port, for the joints of a model."),
    validation=option("--validation", "LOG", "Log to judge on, by name; unless told, what was recorded last."),
    split=option("--split", "HOW", "Judge on the end of every log, 30% or 20s of it; or on whole logs: log."),
    negligible=option(
        "--negligible",
        "PERCENT",
        "Gap that means nothing to you, in percent of the friction level; 5 unless told.",
        min=0.0,
        max=100.0,
    ),
    write_model=option(
        "--write-model",
        "FILE",
        "Write the improved joint as a robot file; with --model, your own file with the causes added.",
    ),
    mujoco=option("--export-mujoco", "FILE.xml", "Export the improved joint to MuJoCo, and FILE.py with its callback."),
    export=option(
        "--export",
        "TARGET=FILE",
        "Also write the joints of a model: isaaclab, mjlab (.py), newton (.usda), ros2 (.yaml), bam, samples "
        "(.json), c (.h).",
    ),
    stage=option("--stage", "FILE", "Your USD stage, over whose joints --export newton is laid; without it a new one."),
    randomise=option("--randomise", "N", "Posterior samples to draw for --export.", min=0),
    apply=typer.Option("--apply", help="Write the best candidate even where the verdict is ambiguous or unknown."),
    out=option("--out", "FOLDER", "Folder for the report page."),
)
def diagnose(
    output: Output,
    logs: list[Path] | None = None,
    model: Path | None = None,
    more_logs: list[Path] | None = None,
    columns: str | None = None,
    nominal: Path | None = None,
    profile: Path | None = None,
    joint: list[str] | None = None,
    hold: list[str] | None = None,
    tolerance: list[str] | None = None,
    executor: str | None = None,
    validation: list[str] | None = None,
    split: str = "",
    negligible: float | None = None,
    write_model: Path | None = None,
    mujoco: Path | None = None,
    export: list[str] | None = None,
    stage: Path | None = None,
    randomise: int = 0,
    apply: bool = False,
    out: Path | None = None,
    force: bool = False,
) -> Result:
    """Say where the gap lives, which unmodelled effect causes it, and how far it closes on recordings never fitted."""
    from frictid_hil.jobs.gap.exports import Wanted
    from frictid_hil.jobs.gap.logs import Source
    from frictid_hil.jobs.gap_diagnose import diagnose as job
    from frictid_hil.jobs.gap_diagnose import diagnose_arm

    every = [*(logs or ()), *(more_logs or ())]
    to_write: dict[str, Any] = {"write_model": write_model, "apply": apply, "out": out, "force": force}
    if model is not None:
        if negligible is not None:
            raise UsageError("--negligible is of one joint; it does not go with --model")
        wanted = Wanted.of(export or (), randomise, stage)
        return diagnose_arm(model_logs(output, every), wanted=wanted, executor_name=executor, **to_write)
    if not every:
        raise UsageError("needs a set or logs")
    if hold or tolerance or executor or export or randomise or stage or len(joint or ()) > 1:
        raise UsageError("--hold, --tolerance, --executor, --export and several joints need --model")
    source = output.options(Source, paths=every, joint=joint[0] if joint else None)
    return job(source, mujoco=mujoco, negligible=None if negligible is None else 0.01 * negligible, **to_write)


def _show_draft(output: Output, result: Result) -> None:
    numbers = result["draft"]["numbers"].items()
    rows = [(name, f"{found['value']:.4g}", f"{found['sigma']:.2g}") for name, found in numbers]
    output.table(("number", "value", "one-sigma"), rows)
    for warning in result["draft"]["warnings"]:
        output.say(f"warning: {warning}")
    output.tell(result, "nominal")


@verb(app, "draft", _show_draft, schema="gap_draft")
@takes(
    logs=argument("SET | LOG...", "Folder with nominal.yaml and its logs; or recordings that lie anywhere."),
    columns=option("--columns", "FILE", "Column map of a foreign logger (emps.yaml)."),
    joint=option("--joint -j", "JOINT", "The joint, where logs or profile hold several."),
    out=option("--out", "FILE", "The file to write."),
)
def draft(
    output: Output,
    logs: list[Path],
    columns: str | None = None,
    joint: str | None = None,
    out: Path = Path("nominal.yaml"),
    force: bool = False,
) -> Result:
    """Draft a first nominal.yaml, with tolerances, from recordings where nothing is believed yet."""
    from frictid_hil.jobs.gap.logs import Source
    from frictid_hil.jobs.gap_diagnose import draft as job

    return job(output.options(Source, paths=logs), out, force=force)


def _show_fleet(output: Output, result: Result) -> None:
    rows = []
    for name, effects in result["joints"].items():
        for effect, numbers in effects.items():
            for number, told in numbers.items():
                low, high = told["between_units"]["interval_95"]
                varies = f"{told['between_units']['value']:.3g} ({low:.2g} .. {high:.2g})"
                row = (name, f"{effect} {number}", f"{told['mean']:.4g}", f"{told['not_known']:.2g}")
                rows.append((*row, varies if told["varies"] else f"not seen, below {high:.2g}"))
    output.table(("joint", "number", "mean", "not known", "varies between robots"), rows)
    output.tell(result, "samples")


@verb(app, "fleet", _show_fleet, schema="gap_fleet")
@takes(
    results=argument("RESULT...", "What `gap diagnose --json` printed, one file a robot."),
    randomise=option("--randomise", "N", "Robots to draw into --out.", min=0),
    out=option("--out", "FILE", "File for the robots drawn (.json)."),
)
def fleet(
    output: Output,
    results: list[Path],
    randomise: int = 0,
    out: Path | None = None,
    seed: int = 1,
    force: bool = False,
) -> Result:
    """Tell what varies between robots of one kind from what is not known of them."""
    from frictid_hil.jobs.gap_fleet import fleet as job

    return job(results, samples=randomise, out=out, force=force, seed=seed)


def _show_check(output: Output, result: Result) -> None:
    for name, one in (result.get("worlds") or {result["world"]: result}).items():
        rows = []
        for figure, rate in one["rates"].items():
            if rate.get("of"):
                interval = f"{100 * rate['low']:.0f} .. {100 * rate['high']:.0f} %"
                rows.append((figure.replace("_", " "), f"{100 * rate['rate']:.1f} %", interval, str(rate["of"])))
        title = f"Blind check, {name} world: {result['cases']} joints, seed {result['seed']}"
        output.table(("figure", "value", "95 % interval", "of"), rows, title=title)


@verb(app, "check", _show_check, schema="gap_check")
@takes(
    cases=option("--cases", "N", "Joints to draw.", min=1),
    seed=option("--seed", "N", "Seed of the draw."),
    world=option("--world", "NAMES", "narrow, wide, zoo, or several with commas."),
    processes=option("--processes", "N", "Parallel processes.", min=1),
    leave_one_out=typer.Option("--leave-one-effect-out", help="Also hold out each effect from the library in turn."),
    out=option("--out", "FOLDER", "Folder to keep cases, answers and scores in."),
)
def check(
    output: Output,
    cases: int = 40,
    seed: int = 1,
    world: str = "narrow",
    processes: int = 2,
    leave_one_out: bool = False,
    out: Path | None = None,
    force: bool = False,
) -> Result:
    """Draw joints whose truth is sealed, diagnose them, open the seal, score the answers."""
    from frictid_hil.jobs.gap_check import run_gap_check

    worlds = [name.strip() for name in world.split(",") if name.strip()]
    more: dict[str, Any] = {"leave_one_out": leave_one_out, "force": force, "progress": output.err.print}
    return run_gap_check(cases, seed, out, processes, worlds=worlds, **more)


def _show_recording(output: Output, result: Result) -> None:
    output.out.print(f"{len(result['experiments'])} experiments: {', '.join(result['experiments'])}")
    output.say(f"set: {result['set']}")
    if told := result.get("diagnosis"):
        output.out.print(told["summary"])
        output.out.print(f"nothing more is recorded: {result['ended_because']}")


@verb(app, "record", _show_recording, schema="gap_record")
@takes(
    joint=option("--joint -j", "JOINT", "The joint to record."),
    short=typer.Option("--short", help="The short set: about a minute of motion."),
    plan=option("--plan", "FILE", "Record just what an ambiguous diagnosis asked for."),
    until_decided=option(
        "--until-decided",
        "SECONDS",
        "Diagnose after each recording and add what tells most, for so many seconds of motion at most.",
    ),
    profile=option("--profile", "PROFILE", "Friction profile that the simulator believes."),
    payload=typer.Option(
        "--payload/--no-payload",
        help="Payload steps too; you are asked to mount it. A simulated robot mounts its own.",
        show_default=False,
    ),
    recorded=option("--from", "RUN", "Make a set of what this run has recorded; nothing moves."),
    out=option("--out", "FOLDER", "Folder of the experiment set."),
)
def record(
    output: Output,
    robot: str = "",
    joint: str = "",
    bus: str | None = None,
    short: bool = False,
    plan: Path | None = None,
    until_decided: float | None = None,
    profile: Path | None = None,
    payload: bool | None = None,
    realtime: bool | None = None,
    seed: int = 0,
    resume: Path | None = None,
    recorded: Path | None = None,
    out: Path | None = None,
    yes: bool = False,
) -> Told:
    """Run the diagnostic experiments on the bus and write an experiment set."""
    from frictid_hil.cli.progress import watching
    from frictid_hil.jobs.gap_record import GapRecordOptions, record_until_decided
    from frictid_hil.jobs.gap_record import record as job

    if resume is not None and recorded is not None:
        raise UsageError("--resume moves the joint and --from does not; give one")
    options = output.options(GapRecordOptions, resume=resume or recorded)
    with watching(output, yes=yes) as watcher:
        if until_decided is not None:
            return record_until_decided(options, watcher, until_decided)
        return job(options, watcher, move=recorded is None)
