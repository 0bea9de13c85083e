"""``gap``: record diagnostic experiments, find where the sim-to-real gap lies and why, check the diagnosis itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from frictid_hil.cli.options import (
    BusOption,
    ForceOption,
    JsonOption,
    QuietOption,
    RealtimeOption,
    ResumeOption,
    RobotOption,
    SeedOption,
    YesOption,
)
from frictid_hil.cli.output import Output, Result, Told
from frictid_hil.cli.tables import folding
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


@app.command("diagnose")
def diagnose(
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
    out: Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Folder for the report page.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Say where the gap lives, which unmodelled effect causes it, and how far it closes on recordings never fitted."""
    from frictid_hil.cli.model_words import model_logs, print_arm
    from frictid_hil.jobs.gap.export_targets import Wanted
    from frictid_hil.jobs.gap_diagnose import Source
    from frictid_hil.jobs.gap_diagnose import diagnose as job
    from frictid_hil.jobs.gap_diagnose_arm import diagnose_arm

    output = Output(as_json, quiet)
    every = [*(logs or ()), *(more_logs or ())]
    of_a_model = hold or tolerance or executor or export or randomise or len(joint or ()) > 1
    if why := _contradiction(every, model, negligible, bool(of_a_model or stage)):
        output.refuse("gap_diagnose", UsageError(why))
    if model is not None:
        output.run(
            "gap_diagnose",
            lambda: diagnose_arm(
                model_logs(model, every, joint, columns, hold, tolerance, validation, split, nominal, profile, mujoco),
                write=write_model,
                apply=apply,
                wanted=Wanted.of(export or (), randomise, stage),
                out=out,
                force=force,
                executor_name=executor,
            ),
            lambda result: print_arm(output, result),
        )
    source = Source(every, columns, nominal, profile, joint[0] if joint else None, validation or (), split)
    share = None if negligible is None else 0.01 * negligible
    output.run(
        "gap_diagnose",
        lambda: job(
            source, write_model=write_model, mujoco=mujoco, apply=apply, out=out, force=force, negligible=share
        ),
        lambda result: _print_diagnosis(output, result),
    )


def _contradiction(every: list[Path], model: Path | None, negligible: float | None, of_a_model: bool) -> str:
    """Why these options do not go together; "" where they do."""
    if model is not None:
        return "" if negligible is None else "--negligible is of one joint; it does not go with --model"
    if not every:
        return "needs a set or logs"
    return "--hold, --tolerance, --executor, --export and several joints need --model" if of_a_model else ""


@app.command("draft")
def draft(
    logs: LogsArgument,
    columns: ColumnsOption = None,
    joint: JointNameOption = None,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file to write.")] = Path("nominal.yaml"),
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Draft a first nominal.yaml, with tolerances, from recordings where nothing is believed yet."""
    from frictid_hil.jobs.gap_diagnose import Source
    from frictid_hil.jobs.gap_diagnose import draft as job

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        table = folding("number", "value", "one-sigma")
        for name, found in result["draft"]["numbers"].items():
            table.add_row(name, f"{found['value']:.4g}", f"{found['sigma']:.2g}")
        output.out.print(table)
        for warning in result["draft"]["warnings"]:
            output.out.print(f"warning: {warning}", soft_wrap=True)
        output.out.print(f"nominal: {result['nominal']}", soft_wrap=True)

    output.run("gap_draft", lambda: job(Source(logs, columns, joint=joint), out, force=force), show)


@app.command("fleet")
def fleet(
    results: Annotated[
        list[Path], typer.Argument(metavar="RESULT...", help="What `gap diagnose --json` printed, one file a robot.")
    ],
    randomise: Annotated[int, typer.Option("--randomise", metavar="N", min=0, help="Robots to draw into --out.")] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="File for the robots drawn (.json).")
    ] = None,
    seed: SeedOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Tell what varies between robots of one kind from what is not known of them."""
    from frictid_hil.jobs.gap_fleet import fleet as job

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        table = folding("joint", "number", "mean", "not known", "varies between robots")
        for name, effects in result["joints"].items():
            for effect, numbers in effects.items():
                for number, told in numbers.items():
                    low, high = told["between_units"]["interval_95"]
                    varies = f"{told['between_units']['value']:.3g} ({low:.2g} .. {high:.2g})"
                    mean = f"{told['mean']:.4g}"
                    row = (name, f"{effect} {number}", mean, f"{told['not_known']:.2g}")
                    table.add_row(*row, varies if told["varies"] else f"not seen, below {high:.2g}")
        output.out.print(table)
        if result.get("samples"):
            output.out.print(f"samples: {result['samples']}", soft_wrap=True)

    output.run("gap_fleet", lambda: job(results, samples=randomise, out=out, force=force, seed=seed), show)


@app.command("check")
def check(
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
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Draw joints whose truth is sealed, diagnose them, open the seal, score the answers."""
    from frictid_hil.jobs.gap_check import run_gap_check

    output = Output(as_json, quiet)

    def show(result: Result) -> None:
        for name, one in (result.get("worlds") or {result["world"]: result}).items():
            title = f"Blind check, {name} world: {cases} joints, seed {seed}"
            table = folding("figure", "value", "95 % interval", "of", title=title)
            for figure, rate in one["rates"].items():
                if rate.get("of"):
                    interval = f"{100 * rate['low']:.0f} .. {100 * rate['high']:.0f} %"
                    table.add_row(figure.replace("_", " "), f"{100 * rate['rate']:.1f} %", interval, str(rate["of"]))
            output.out.print(table)

    output.run(
        "gap_check",
        lambda: run_gap_check(
            cases,
            seed,
            out,
            worlds=[name.strip() for name in world.split(",") if name.strip()],
            processes=processes,
            leave_one_out=leave_one_out,
            force=force,
            progress=output.err.print,
        ),
        show,
    )


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


@app.command("record")
def record(
    robot: RobotOption = "",
    joint: Annotated[str, typer.Option("--joint", "-j", metavar="JOINT", help="The joint to record.")] = "",
    bus: BusOption = None,
    short: Annotated[bool, typer.Option("--short", help="The short set: about a minute of motion.")] = False,
    plan: PlanOption = None,
    until_decided: UntilDecidedOption = None,
    profile: ProfileOption = None,
    payload: PayloadOption = None,
    realtime: RealtimeOption = False,
    seed: SeedOption = 0,
    resume: ResumeOption = None,
    recorded: RecordedOption = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FOLDER", help="Folder of the experiment set.")] = None,
    yes: YesOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run the diagnostic experiments on the bus and write an experiment set."""
    from frictid_hil.cli.progress import TerminalWatcher
    from frictid_hil.jobs.gap_decide import record_until_decided
    from frictid_hil.jobs.gap_record import GapRecordOptions
    from frictid_hil.jobs.gap_record import record as job

    output = Output(as_json, quiet)
    watcher = TerminalWatcher(output, yes=yes)
    options = GapRecordOptions(
        robot=robot,
        joint=joint,
        bus=bus,
        short=short,
        plan=plan,
        profile=profile,
        payload=payload,
        realtime=realtime,
        seed=seed,
        out=out,
        resume=resume or recorded,
    )

    def run() -> Told:
        if resume is not None and recorded is not None:
            raise UsageError("--resume moves the joint and --from does not; give one")
        try:
            if until_decided is not None:
                return record_until_decided(options, watcher, until_decided)
            return job(options, watcher, move=recorded is None)
        finally:
            watcher.close()

    def show(result: Result) -> None:
        output.out.print(f"{len(result['experiments'])} experiments: {', '.join(result['experiments'])}")
        output.out.print(f"set: {result['set']}", soft_wrap=True)
        if told := result.get("diagnosis"):
            output.out.print(told["summary"])
            output.out.print(f"nothing more is recorded: {result['ended_because']}")

    output.run("gap_record", run, show)


def _print_diagnosis(output: Output, result: Result) -> None:
    output.out.print(result["summary"], style="bold")
    causes = folding("cause", "confidence", "closes", "parameters", "confusable with", whole=("cause", "closes"))
    for cause in result["causes"]:
        parameters = ", ".join(
            f"{name} = {value['value']:.4g}" if isinstance(value, dict) else f"{name} = {value:.4g}"
            for name, value in cause["parameters"].items()
        )
        closed = cause["gap_closed_percent"]
        causes.add_row(
            cause["effect"],
            f"{cause['confidence']:.2f}",
            "" if closed is None else f"{closed:.0f} %",
            parameters,
            ", ".join(cause["confusable_with"]),
        )
    if result["causes"]:
        output.out.print(causes)
    where = folding("where", "share of gap", "", "", whole=("where",))
    for region in result["where"]:
        share = region["share_of_gap"]
        if share >= 0.005:
            where.add_row(region["region"], f"{100 * share:.0f} %", "█" * round(30 * share), region["description"])
    output.out.print(where)
    gap = folding("on validation logs", "before", "after", "noise floor")
    for name in ("inverse_nm", "forward_torque_nm", "forward_position_rad"):
        row = [result["gap"][state][name] for state in ("before", "after", "noise_floor")]
        gap.add_row(name, *("-" if value is None else f"{value:.4g}" for value in row))
    output.out.print(gap)
    if asked := result.get("next_experiment"):
        output.out.print(f"record next ({asked['duration_s']:.0f} s): {asked['description']}")
    for subject, why in result["reasons"].items():
        output.out.print(f"{subject}: {why}")
    if exported := result.get("mujoco"):
        output.out.print(f"mujoco: {exported['model']} and {exported['callback_script']}", soft_wrap=True)
        for lost in exported["lost"]:
            output.out.print(f"  lost: {lost}")
    for key in ("model", "report"):
        if result.get(key):
            output.out.print(f"{key}: {result[key]}", soft_wrap=True)
    if result.get("model_refused"):
        output.out.print(f"no model was written: {result['model_refused']}", soft_wrap=True)
