"""``gap``: record diagnostic experiments, find where the sim-to-real gap lies and why, check the diagnosis itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from frictid_hil.cli import options as opt
from frictid_hil.cli.model_words import model_logs, print_arm
from frictid_hil.cli.options import argument, option
from frictid_hil.cli.output import Output, Result, Told, verb
from frictid_hil.errors import UsageError

app = typer.Typer(
    help="Where the simulator differs from the machine, why, and how far it closes.", no_args_is_help=True
)


LogsArgument = Annotated[
    list[Path], argument("SET | LOG...", "Folder with nominal.yaml and its logs; or recordings that lie anywhere.")
]
ReportFolderOption = Annotated[Path | None, option("--out", "FOLDER", "Folder for the report page.")]
ColumnsOption = Annotated[str | None, option("--columns", "FILE", "Column map of a foreign logger (emps.yaml).")]
JointNameOption = Annotated[str | None, option("--joint -j", "JOINT", "The joint, where logs or profile hold several.")]


DiagnoseLogsArgument = Annotated[
    list[Path] | None,
    argument("[SET | LOG...]", "Folder with nominal.yaml and its logs; or recordings that lie anywhere."),
]
ModelOption = Annotated[
    Path | None, option("--model", "FILE", "Your own robot model, MJCF or URDF: every joint is diagnosed.")
]
MoreLogsOption = Annotated[list[Path] | None, option("--log", "LOG", "A recording; as those without an option.")]
NominalOption = Annotated[Path | None, option("--nominal", "FILE", "What the simulator believes (nominal.yaml).")]
ProfileOption = Annotated[Path | None, option("--profile", "PROFILE", "Friction profile that the simulator believes.")]
JointOption = Annotated[
    list[str] | None,
    option(
        "--joint -j",
        "JOINT",
        "The joint, where logs or profile hold several; of a model several times, or NAME=NAME_IN_LOG.",
    ),
]
HoldOption = Annotated[
    list[str] | None, option("--hold", "JOINT=20deg", "Where a joint of the model stood that no log has.")
]
ToleranceOption = Annotated[
    list[str] | None,
    option(
        "--tolerance",
        "NUMBER=SIGMA",
        "One-sigma of a number of the model, relative or data_sheet, cad, profile; JOINT:NUMBER=... for one.",
    ),
]
ExecutorOption = Annotated[
    str | None, option("--executor", "WHERE", "processes:N, or dask://host:port, for the joints of a model.")
]
ValidationOption = Annotated[
    list[str] | None, option("--validation", "LOG", "Log to judge on, by name; unless told, what was recorded last.")
]
SplitOption = Annotated[
    str, option("--split", "HOW", "Judge on the end of every log, 30% or 20s of it; or on whole logs: log.")
]
NegligibleOption = Annotated[
    float | None,
    option(
        "--negligible",
        "PERCENT",
        "Gap that means nothing to you, in percent of the friction level; 5 unless told.",
        min=0.0,
        max=100.0,
    ),
]
WriteModelOption = Annotated[
    Path | None,
    option(
        "--write-model",
        "FILE",
        "Write the improved joint as a robot file; with --model, your own file with the causes added.",
    ),
]
MujocoOption = Annotated[
    Path | None,
    option("--export-mujoco", "FILE.xml", "Export the improved joint to MuJoCo, and FILE.py with its callback."),
]
ExportOption = Annotated[
    list[str] | None,
    option(
        "--export",
        "TARGET=FILE",
        "Also write the joints of a model: isaaclab, mjlab (.py), newton (.usda), ros2 (.yaml), bam, samples "
        "(.json), c (.h).",
    ),
]
StageOption = Annotated[
    Path | None,
    option("--stage", "FILE", "Your USD stage, over whose joints --export newton is laid; without it a new one."),
]
RandomiseOption = Annotated[int, option("--randomise", "N", "Posterior samples to draw for --export.", min=0)]
ApplyOption = Annotated[
    bool, typer.Option("--apply", help="Write the best candidate even where the verdict is ambiguous or unknown.")
]


def _show_diagnosis(output: Output, result: Result) -> None:
    if "model_in" in result:
        print_arm(output, result)
        return
    output.out.print(result["summary"], style="bold")
    if causes := [_cause(cause) for cause in result["causes"]]:
        output.table(("cause", "confidence", "closes", "parameters", "confusable with"), causes, ("cause", "closes"))
    shares = [(region, region["share_of_gap"]) for region in result["where"]]
    where = [(r["region"], f"{100 * s:.0f} %", "█" * round(30 * s), r["description"]) for r, s in shares if s >= 0.005]
    output.table(("where", "share of gap", "", ""), where, ("where",))
    gap = []
    for name in ("inverse_nm", "forward_torque_nm", "forward_position_rad"):
        row = [result["gap"][state][name] for state in ("before", "after", "noise_floor")]
        gap.append((name, *("-" if value is None else f"{value:.4g}" for value in row)))
    output.table(("on validation logs", "before", "after", "noise floor"), gap)
    if asked := result.get("next_experiment"):
        output.out.print(f"record next ({asked['duration_s']:.0f} s): {asked['description']}")
    for subject, why in result["reasons"].items():
        output.out.print(f"{subject}: {why}")
    if exported := result.get("mujoco"):
        output.say(f"mujoco: {exported['model']} and {exported['callback_script']}")
        for lost in exported["lost"]:
            output.out.print(f"  lost: {lost}")
    output.tell(result, "model", "report")
    if result.get("model_refused"):
        output.say(f"no model was written: {result['model_refused']}")


def _cause(cause: Result) -> tuple[str, ...]:
    parameters = ", ".join(
        f"{name} = {value['value']:.4g}" if isinstance(value, dict) else f"{name} = {value:.4g}"
        for name, value in cause["parameters"].items()
    )
    closed = "" if cause["gap_closed_percent"] is None else f"{cause['gap_closed_percent']:.0f} %"
    return cause["effect"], f"{cause['confidence']:.2f}", closed, parameters, ", ".join(cause["confusable_with"])


@verb(app, "diagnose", _show_diagnosis, schema="gap_diagnose")
def diagnose(
    output: Output,
    logs: DiagnoseLogsArgument = None,
    model: ModelOption = None,
    more_logs: MoreLogsOption = None,
    columns: ColumnsOption = None,
    nominal: NominalOption = None,
    profile: ProfileOption = None,
    joint: JointOption = None,
    hold: HoldOption = None,
    tolerance: ToleranceOption = None,
    executor: ExecutorOption = None,
    validation: ValidationOption = None,
    split: SplitOption = "",
    negligible: NegligibleOption = None,
    write_model: WriteModelOption = None,
    mujoco: MujocoOption = None,
    export: ExportOption = None,
    stage: StageOption = None,
    randomise: RandomiseOption = 0,
    apply: ApplyOption = False,
    out: ReportFolderOption = None,
    force: opt.Force = False,
) -> Result:
    """Say where the gap lives, which unmodelled effect causes it, and how far it closes on recordings never fitted."""
    from frictid_hil.jobs.gap.export_targets import Wanted
    from frictid_hil.jobs.gap.logs import Source
    from frictid_hil.jobs.gap_diagnose import diagnose as job
    from frictid_hil.jobs.gap_diagnose_arm import diagnose_arm

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
def draft(
    output: Output,
    logs: LogsArgument,
    columns: ColumnsOption = None,
    joint: JointNameOption = None,
    out: Annotated[Path, option("--out", "FILE", "The file to write.")] = Path("nominal.yaml"),
    force: opt.Force = False,
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
def fleet(
    output: Output,
    results: Annotated[list[Path], argument("RESULT...", "What `gap diagnose --json` printed, one file a robot.")],
    randomise: Annotated[int, option("--randomise", "N", "Robots to draw into --out.", min=0)] = 0,
    out: Annotated[Path | None, option("--out", "FILE", "File for the robots drawn (.json).")] = None,
    seed: opt.Seed = 1,
    force: opt.Force = False,
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
def check(
    output: Output,
    cases: Annotated[int, option("--cases", "N", "Joints to draw.", min=1)] = 40,
    seed: Annotated[int, option("--seed", "N", "Seed of the draw.")] = 1,
    world: Annotated[str, option("--world", "NAMES", "narrow, wide, zoo, or several with commas.")] = "narrow",
    processes: Annotated[int, option("--processes", "N", "Parallel processes.", min=1)] = 2,
    leave_one_out: Annotated[
        bool, typer.Option("--leave-one-effect-out", help="Also hold out each effect from the library in turn.")
    ] = False,
    out: Annotated[Path | None, option("--out", "FOLDER", "Folder to keep cases, answers and scores in.")] = None,
    force: opt.Force = False,
) -> Result:
    """Draw joints whose truth is sealed, diagnose them, open the seal, score the answers."""
    from frictid_hil.jobs.gap_check import run_gap_check

    worlds = [name.strip() for name in world.split(",") if name.strip()]
    more: dict[str, Any] = {"leave_one_out": leave_one_out, "force": force, "progress": output.err.print}
    return run_gap_check(cases, seed, out, processes, worlds=worlds, **more)


PlanOption = Annotated[Path | None, option("--plan", "FILE", "Record just what an ambiguous diagnosis asked for.")]
UntilDecidedOption = Annotated[
    float | None,
    option(
        "--until-decided",
        "SECONDS",
        "Diagnose after each recording and add what tells most, for so many seconds of motion at most.",
    ),
]
PayloadOption = Annotated[
    bool | None,
    typer.Option(
        "--payload/--no-payload",
        help="Payload steps too; you are asked to mount it. A simulated robot mounts its own.",
        show_default=False,
    ),
]
RecordedOption = Annotated[
    Path | None, option("--from", "RUN", "Make a set of what this run has recorded; nothing moves.")
]


def _show_recording(output: Output, result: Result) -> None:
    output.out.print(f"{len(result['experiments'])} experiments: {', '.join(result['experiments'])}")
    output.say(f"set: {result['set']}")
    if told := result.get("diagnosis"):
        output.out.print(told["summary"])
        output.out.print(f"nothing more is recorded: {result['ended_because']}")


@verb(app, "record", _show_recording, schema="gap_record")
def record(
    output: Output,
    robot: opt.Robot = "",
    joint: Annotated[str, option("--joint -j", "JOINT", "The joint to record.")] = "",
    bus: opt.Bus = None,
    short: Annotated[bool, typer.Option("--short", help="The short set: about a minute of motion.")] = False,
    plan: PlanOption = None,
    until_decided: UntilDecidedOption = None,
    profile: ProfileOption = None,
    payload: PayloadOption = None,
    realtime: opt.Realtime = None,
    seed: opt.Seed = 0,
    resume: opt.Resume = None,
    recorded: RecordedOption = None,
    out: Annotated[Path | None, option("--out", "FOLDER", "Folder of the experiment set.")] = None,
    yes: opt.Yes = False,
) -> Told:
    """Run the diagnostic experiments on the bus and write an experiment set."""
    from frictid_hil.cli.progress import watching
    from frictid_hil.jobs.gap_decide import record_until_decided
    from frictid_hil.jobs.gap_record import GapRecordOptions
    from frictid_hil.jobs.gap_record import record as job

    if resume is not None and recorded is not None:
        raise UsageError("--resume moves the joint and --from does not; give one")
    options = output.options(GapRecordOptions, resume=resume or recorded)
    with watching(output, yes=yes) as watcher:
        if until_decided is not None:
            return record_until_decided(options, watcher, until_decided)
        return job(options, watcher, move=recorded is None)
