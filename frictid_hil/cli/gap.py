"""``gap``: record diagnostic experiments, find where the sim-to-real gap lies and why, check the diagnosis itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from frictid_hil.cli.model_words import model_logs, print_arm
from frictid_hil.cli.options import (
    BusOption,
    ForceOption,
    RealtimeOption,
    ResumeOption,
    RobotOption,
    SeedOption,
    YesOption,
)
from frictid_hil.cli.output import Output, Result, Told, verb
from frictid_hil.errors import UsageError

app = typer.Typer(
    help="Where the simulator differs from the machine, why, and how far it closes.", no_args_is_help=True
)


LogsArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="SET | LOG...", help="Folder with nominal.yaml and its logs; or recordings that lie anywhere."
    ),
]
ReportFolderOption = Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Folder for the report page.")]
ColumnsOption = Annotated[
    str | None, typer.Option("--columns", metavar="FILE", help="Column map of a foreign logger (emps.yaml).")
]
JointNameOption = Annotated[
    str | None, typer.Option("--joint", "-j", metavar="JOINT", help="The joint, where logs or profile hold several.")
]


DiagnoseLogsArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="[SET | LOG...]", help="Folder with nominal.yaml and its logs; or recordings that lie anywhere."
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", metavar="FILE", help="Your own robot model, MJCF or URDF: every joint is diagnosed."),
]
MoreLogsOption = Annotated[
    list[Path] | None, typer.Option("--log", metavar="LOG", help="A recording; as those without an option.")
]
NominalOption = Annotated[
    Path | None, typer.Option("--nominal", metavar="FILE", help="What the simulator believes (nominal.yaml).")
]
ProfileOption = Annotated[
    Path | None, typer.Option("--profile", metavar="PROFILE", help="Friction profile that the simulator believes.")
]
JointOption = Annotated[
    list[str] | None,
    typer.Option(
        "--joint",
        "-j",
        metavar="JOINT",
        help="The joint, where logs or profile hold several; of a model several times, or NAME=NAME_IN_LOG.",
    ),
]
HoldOption = Annotated[
    list[str] | None,
    typer.Option("--hold", metavar="JOINT=20deg", help="Where a joint of the model stood that no log has."),
]
ToleranceOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tolerance",
        metavar="NUMBER=SIGMA",
        help="One-sigma of a number of the model, relative or data_sheet, cad, profile; JOINT:NUMBER=... for one.",
    ),
]
ExecutorOption = Annotated[
    str | None,
    typer.Option("--executor", metavar="WHERE", help="processes:N, or dask://host:port, for the joints of a model."),
]
ValidationOption = Annotated[
    list[str] | None,
    typer.Option("--validation", metavar="LOG", help="Log to judge on, by name; unless told, what was recorded last."),
]
SplitOption = Annotated[
    str,
    typer.Option(
        "--split", metavar="HOW", help="Judge on the end of every log, 30% or 20s of it; or on whole logs: log."
    ),
]
NegligibleOption = Annotated[
    float | None,
    typer.Option(
        "--negligible",
        metavar="PERCENT",
        min=0.0,
        max=100.0,
        help="Gap that means nothing to you, in percent of the friction level; 5 unless told.",
    ),
]
WriteModelOption = Annotated[
    Path | None,
    typer.Option(
        "--write-model",
        metavar="FILE",
        help="Write the improved joint as a robot file; with --model, your own file with the causes added.",
    ),
]
MujocoOption = Annotated[
    Path | None,
    typer.Option(
        "--export-mujoco",
        metavar="FILE.xml",
        help="Export the improved joint to MuJoCo, and FILE.py with its callback.",
    ),
]
ExportOption = Annotated[
    list[str] | None,
    typer.Option(
        "--export",
        metavar="TARGET=FILE",
        help="Also write the joints of a model: isaaclab, mjlab (.py), newton (.usda), ros2 (.yaml), bam, samples "
        "(.json), c (.h).",
    ),
]
StageOption = Annotated[
    Path | None,
    typer.Option(
        "--stage",
        metavar="FILE",
        help="Your USD stage, over whose joints --export newton is laid; without it a new one.",
    ),
]
RandomiseOption = Annotated[
    int, typer.Option("--randomise", metavar="N", min=0, help="Posterior samples to draw for --export.")
]
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
    force: ForceOption = False,
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
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file to write.")] = Path("nominal.yaml"),
    force: ForceOption = False,
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
    results: Annotated[
        list[Path], typer.Argument(metavar="RESULT...", help="What `gap diagnose --json` printed, one file a robot.")
    ],
    randomise: Annotated[int, typer.Option("--randomise", metavar="N", min=0, help="Robots to draw into --out.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="File for the robots drawn (.json).")
    ] = None,
    seed: SeedOption = 1,
    force: ForceOption = False,
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
    cases: Annotated[int, typer.Option("--cases", metavar="N", min=1, help="Joints to draw.")] = 40,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Seed of the draw.")] = 1,
    world: Annotated[
        str, typer.Option("--world", metavar="NAMES", help="narrow, wide, zoo, or several with commas.")
    ] = "narrow",
    processes: Annotated[int, typer.Option("--processes", metavar="N", min=1, help="Parallel processes.")] = 2,
    leave_one_out: Annotated[
        bool, typer.Option("--leave-one-effect-out", help="Also hold out each effect from the library in turn.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Folder to keep cases, answers and scores in.")
    ] = None,
    force: ForceOption = False,
) -> Result:
    """Draw joints whose truth is sealed, diagnose them, open the seal, score the answers."""
    from frictid_hil.jobs.gap_check import run_gap_check

    worlds = [name.strip() for name in world.split(",") if name.strip()]
    more: dict[str, Any] = {"leave_one_out": leave_one_out, "force": force, "progress": output.err.print}
    return run_gap_check(cases, seed, out, processes, worlds=worlds, **more)


PlanOption = Annotated[
    Path | None, typer.Option("--plan", metavar="FILE", help="Record just what an ambiguous diagnosis asked for.")
]
UntilDecidedOption = Annotated[
    float | None,
    typer.Option(
        "--until-decided",
        metavar="SECONDS",
        help="Diagnose after each recording and add what tells most, for so many seconds of motion at most.",
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
    Path | None,
    typer.Option("--from", metavar="RUN", help="Make a set of what this run has recorded; nothing moves."),
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
    robot: RobotOption = "",
    joint: Annotated[str, typer.Option("--joint", "-j", metavar="JOINT", help="The joint to record.")] = "",
    bus: BusOption = None,
    short: Annotated[bool, typer.Option("--short", help="The short set: about a minute of motion.")] = False,
    plan: PlanOption = None,
    until_decided: UntilDecidedOption = None,
    profile: ProfileOption = None,
    payload: PayloadOption = None,
    realtime: RealtimeOption = None,
    seed: SeedOption = 0,
    resume: ResumeOption = None,
    recorded: RecordedOption = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Folder of the experiment set.")] = None,
    yes: YesOption = False,
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
