"""``palpate weigh``: what does the arm hold?"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError
from . import STOPPED
from ._common import (
    DEFAULT_ARM,
    ArmOrRecorded,
    Base,
    Columns,
    Effort,
    Json,
    Noise,
    Quiet,
    RecordedLog,
    Repair,
    Seed,
    Tip,
    a_log,
    check_target,
    console,
    emit,
    examples,
    is_png,
    is_recording,
    is_report,
    make_folder,
    mass_text,
    only,
    open_arm,
    open_log,
    picture_png,
    print_rows,
    say,
    status_words,
)
from ._drivers import (
    Bus,
    DriverName,
    Host,
    Port,
    Rate,
    Stamp,
    States,
    Topic,
    line_summary,
    line_words,
    make_driver,
    make_watcher,
)

if TYPE_CHECKING:
    from ..arm import Arm
    from ..drivers import Driver
    from ..logs import Log
    from ..weigh import Task, Trial, Weighing


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "weigh",
        help="Weigh what an arm holds, without a force sensor.\n\n"
        "Without LOG a simulated arm lifts an object from rest to a grasping pose, with noise and quantisation. "
        "With LOG the same is done for a recording of a real arm. With --driver a real arm itself moves from where it "
        "stands to --pose: hold it, its drives are off before and after (ur and fri: held by its controller). "
        "Writes run.mcap (not with LOG) and "
        "report.html into the current folder; both replace those of an earlier run.",
        epilog=examples(
            "palpate weigh",
            "palpate weigh --mass 0.4 --pose StandBy --seed 7",
            "palpate weigh --arm kuka_lbr_iiwa7 --out /tmp/iiwa --json",
            "palpate weigh --duration 6 --picture weigh.png",
            "palpate weigh task.mcap --arm robot.arm.yaml",
            "palpate weigh --driver dynamixel --port /dev/ttyUSB0 --bus bus.yaml --arm arm.yaml --pose 0,-0.5,1",
            "palpate weigh --driver ros --topic /joint_states --arm robot.arm.yaml --duration 20",
            "palpate weigh --driver ur --host 192.168.1.10 --arm ur10e.arm.yaml --pose 0,-1.2,1.4,-1.5,-1.3,0",
            "palpate weigh log.csv --columns columns.yaml --arm robot.urdf --tip tool0 --effort torque",
        ),
    )(run)


def run(
    log: RecordedLog = None,
    arm: ArmOrRecorded = None,
    mass: Annotated[
        float | None,
        typer.Option(metavar="KG", help="Mass to lift. [default: 0.25 for Justina]", show_default=False),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="POSE",
            help="Pose to weigh in: a name (Take3, StandBy, ...) or angles in rad, separated by commas. "
            "[default: Take3 for Justina]",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="POSE", help="Pose to start from. [default: zero]", show_default=False),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="payload-filter, regression or joint-formula. [default: payload-filter]",
            show_default=False,
        ),
    ] = None,
    observer: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Where the external torque comes from: extended-kalman, momentum, super-twisting, sliding-mode, "
            "disturbance-kalman, inverse-dynamics, model-residual or none. [default: extended-kalman]",
            show_default=False,
        ),
    ] = None,
    seed: Seed = 0,
    duration: Annotated[float, typer.Option(metavar="S", help="How long to simulate.")] = 10.0,
    noise: Noise = True,
    speed: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Simulated seconds per second. [default: 2 with the live table, else as fast as it goes]",
            show_default=False,
        ),
    ] = None,
    driver: DriverName = None,
    port: Port = None,
    host: Host = None,
    bus: Bus = None,
    rate: Rate = None,
    topic: Topic = None,
    states: States = None,
    stamp: Stamp = None,
    columns: Columns = None,
    effort: Effort = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the files.")] = Path(),
    record: Annotated[bool, typer.Option("--record/--no-record", help="Write run.mcap.")] = True,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    picture: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG",
            help="Also write one picture of the simulated arm and the mass it finds, for a slide.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Weigh."""
    from .. import weigh as weighing

    if log is not None:
        a_log(log)
        given = {"--mass": mass, "--pose": pose, "--start": start, "--speed": speed, "--picture": picture}
        only("a simulation", "LOG is a recording", given)
        only("a real arm", "LOG is a recording", {"--driver": driver})
    else:
        only("a LOG", "nothing is recorded yet", {"--columns": columns})
    if driver != "ros":
        only("--driver ros", "it is not given", {"--topic": topic, "--states": states, "--stamp": stamp})
    if driver is None:
        only(
            "a real arm",
            "there is no --driver",
            {"--port": port, "--host": host, "--bus": bus, "--rate": rate},
        )
        if log is None:
            only("a LOG", "nothing is recorded yet", {"--effort": effort})
    elif driver == "ros":
        given = {"--mass": mass, "--start": start, "--speed": speed, "--picture": picture}
        only("a simulation", "the arm is real", given)
        only(
            "an arm that palpate moves",
            "others move this one",
            {"--pose": pose, "--port": port, "--host": host, "--bus": bus},
        )
    else:
        given = {"--mass": mass, "--start": start, "--speed": speed, "--picture": picture}
        only("a simulation", "the arm is real", given)
        only("a real arm's card", "the driver says what its effort is", {"--effort": effort})
    page = out / "report.html"
    if report:
        make_folder(out)
        check_target(page, is_report, "the report")
    if picture is not None:
        check_target(picture, is_png, "the picture")
    files: dict[str, str] = {}
    on_bus: dict[str, Any] | None = None
    scene_png = None
    live = not (json or quiet) and console().is_terminal

    if log is not None:
        model = None if arm is None else open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
        result = weighing.weigh_log(open_log(log, columns), model, estimator=estimator, observer=observer)
        title = f"What {result.arm.name} holds in {log.name}"
    elif driver == "ros":
        if arm is None:
            raise InputError("--driver ros needs --arm: which arm is published?")
        model = open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
        watcher = make_watcher(model, topic=topic, states=states, stamp=stamp, rate=rate)
        watched = _watch(model, watcher, duration)
        if record:
            files["log"] = str(_recording(out))
            watched.save(files["log"], overwrite=True)
        result = weighing.weigh_log(watched, model, estimator=estimator, observer=observer)
        title = f"What {result.arm.name} holds"
    elif driver is not None:
        model = _real_arm(arm, pose, base=base, tip=tip, repair=repair)
        hardware = make_driver(driver, model, port=port, bus=bus, host=host, rate=rate)
        target = _recording(out) if record else None
        with hardware:
            scene = weighing.scene(weighing.driven_arm(model, hardware))
            name, goal = weighing.find_pose(scene, pose or "")
            task = weighing.Task(
                scene=scene,
                start=weighing.present_pose(scene.arm, hardware),
                poses=(goal,),
                loads=None,
                duration=duration,
                rate=1e9 / hardware.period_ns,
            )
            pipeline, _ = weighing.make_pipeline(scene.arm, estimator, observer)
            trial = _trial(task, pipeline, target, live=live, pose=name, picture=False, driver=hardware)
        result = weighing.weigh_trial(trial, pose=name)
        on_bus = line_summary(hardware, trial)
        if target is not None:
            files["log"] = str(target)
        title = f"What {scene.arm.name} holds"
    else:
        if mass is not None:
            weighing.check_mass(mass)
        scene = weighing.scene(open_arm(arm or DEFAULT_ARM, base=base, tip=tip, repair=repair), mass=mass)
        name, goal = weighing.find_pose(scene, pose or scene.pose)
        held = scene.mass if mass is None else mass
        task = weighing.Task(
            scene=scene,
            start=weighing.find_pose(scene, start or scene.start)[1],
            poses=(goal,),
            loads=((0.0, held),),
            duration=duration,
            noise=noise,
            seed=seed,
            speed=2.0 if live and speed is None else speed,
        )
        pipeline, _ = weighing.make_pipeline(scene.arm, estimator, observer)
        target = _recording(out) if record else None
        trial = _trial(task, pipeline, target, live=live, pose=name, picture=report or picture is not None)
        result = weighing.weigh_trial(trial, pose=name)
        if target is not None:
            files["log"] = str(target)
        if trial.picture is not None:
            scene_png = picture_png(trial.picture)
        elif picture is not None:
            raise InputError(f"{picture} cannot be drawn: {trial.picture_error or 'the run was stopped'}")
        elif trial.picture_error and not (json or quiet):
            say(f"no picture: {trial.picture_error}")
        title = f"{scene.arm.name} weighs {held:g} kg"
    if report or picture is not None:
        from ..report import hero_picture, write_weigh_report

        told = result.report(title=title, picture=scene_png)
        if report:
            files["report"] = str(write_weigh_report(told, page))
        if picture is not None:
            files["picture"] = str(hero_picture(told, picture))
    if json:
        emit({**result.summary(), **({} if on_bus is None else {"bus": on_bus}), "files": files})
    elif quiet:
        say(_short(result))
    else:
        _tell(result, files, on_bus)
    return STOPPED if result.interrupted else 0


def _real_arm(arm: str | None, pose: str | None, *, base: str | None, tip: str | None, repair: bool) -> Arm:
    """The arm's model; which arm it is and where it goes are not guessed where a real one moves."""
    if arm is None:
        raise InputError("--driver needs --arm: which arm hangs on the port?")
    if pose is None:
        raise InputError("--driver needs --pose: where may the arm go?")
    return open_arm(arm, base=base, tip=tip, repair=repair)


def _watch(model: Arm, driver: Driver, seconds: float) -> Log:
    """What is published of an arm that others move."""
    from .. import ros
    from ._live import interruptible

    with interruptible() as stopped, driver:
        return ros.collect(model, driver, seconds, stop=stopped)


def _recording(out: Path) -> Path:
    """Where the run is recorded."""
    target = make_folder(out) / "run.mcap"
    check_target(target, is_recording, "the recording")
    return target


def _trial(
    task: Task,
    pipeline: Any,
    target: Path | None,
    *,
    live: bool,
    pose: str,
    picture: bool,
    driver: Driver | None = None,
) -> Trial:
    from ..weigh import run as run_trial
    from ._live import LiveTable, interruptible

    with interruptible() as stopped:
        if not live:
            return run_trial(task, pipeline, driver=driver, record=target, stop=stopped, picture=picture)
        with LiveTable(task, pose) as table:
            return run_trial(
                task,
                pipeline,
                driver=driver,
                record=target,
                stop=stopped,
                progress=table.update,
                picture=picture,
            )


def _short(result: Weighing) -> str:
    text = f"{mass_text(result.mass, result.mass_std)} (95 %), {result.status.name}"
    if result.status.name != "ok":
        return f"{text}: do not use"
    return text


def _tell(result: Weighing, files: dict[str, str], on_bus: dict[str, Any] | None) -> None:
    """The result for people."""
    from rich.text import Text

    good = result.status.name == "ok"
    rows: list[tuple[str, Text | str]] = [("what", _what(result))]
    mass = Text(mass_text(result.mass, result.mass_std), style="bold" if good else "dim")
    mass.append(" (95 %)", style="dim" if not good else "")
    if not good:
        mass.append("   not to be used", style="bold red")
    rows.append(("mass", mass))
    if result.true_mass == result.true_mass:
        truth = mass_text(result.true_mass, float("nan"))
        error = result.error_percent
        rows.append(("truth", truth + (f", error {round(error, 2) + 0.0:+.2f} %" if error == error else "")))
    status = Text(result.status.name, style="green" if good else "bold red")
    status.append(f": {status_words(result.status)}", style="")
    rows.append(("status", status))
    settled = result.time_to_2_percent
    if settled == settled:
        rows.append(("known", _known(result, settled)))
    times = result.change_times
    if len(times):
        rows.append(("changes", _changes(result)))
    rows.append(
        (
            "method",
            result.method()
            + (f", seed {result.task.seed}" if result.task is not None and result.task.simulated else ""),
        )
    )
    if on_bus is not None:
        rows.append(("bus", line_words(on_bus)))
    if result.task is None:
        repair = str(result.log.repair).splitlines()
        rows.append(("read", "\n".join(repair)))
    rows.extend((name, str(path)) for name, path in files.items())
    print_rows(rows, result.remarks)


def _what(result: Weighing) -> str:
    log = result.log
    size = f"{len(log)} samples, {log.duration:.3g} s, {log.rate:.3g} Hz"
    if result.task is None:
        return f"{result.arm.name}: {size}"
    if not result.task.simulated:
        return f"{result.arm.name} moves to pose {result.pose}: {size}"
    thing = "an object" if result.task.mass_at(result.task.duration) > 0.0 else "nothing"
    return f"{result.arm.name} (simulated) lifts {thing} to pose {result.pose}: {size}"


def _known(result: Weighing, settled: float) -> str:
    if settled == float("inf"):
        return "not within 2 % of the truth by the end"
    text = f"within 2 % of the truth for good after {settled:.2f} s"
    if result.task is not None:
        from ..weigh import arrival

        stop = arrival(result.task)
        if settled < stop:
            text += f", before the arm stopped at {stop:.2f} s"
    return text


def _changes(result: Weighing) -> str:
    holds = result.holds
    lines = []
    for before, after in pairwise(holds):
        lines.append(
            f"at {after.start:.2f} s from {mass_text(before.mass, before.mass_std)} "
            f"to {mass_text(after.mass, after.mass_std)}"
        )
    return "\n".join(lines)
