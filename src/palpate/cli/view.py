"""``palpate view``: an arm, live or recorded, on a page in the browser."""

from __future__ import annotations

import ipaddress
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
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
    emit,
    examples,
    make_folder,
    only,
    open_arm,
    open_log,
    say,
)
from ._drivers import Bus, DriverName, Host, Port, Stamp, States, Topic, make_driver, make_watcher

if TYPE_CHECKING:
    from ..arm import Arm
    from ..drivers import Driver
    from ..view import Source


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "view",
        help="Show an arm in the browser: what it holds, what pushes it, how sure that is.\n\n"
        "Without LOG a simulated arm moves where you send it, takes objects and is pushed. With LOG a recording is "
        "gone through by a slider. With --driver it is a real arm, whose drives are off until you switch them on. "
        "The page stays on this computer unless --listen says otherwise; Ctrl-C ends it.",
        epilog=examples(
            "palpate view",
            "palpate view --arm kuka_lbr_iiwa7 --mass 3 --rate 1000",
            "palpate view run.mcap",
            "palpate view log.csv --columns columns.yaml --arm robot.urdf --tip tool0 --effort torque",
            "palpate view --driver dynamixel --port /dev/ttyUSB0 --bus bus.yaml --arm arm.yaml",
            "palpate view --driver ur --host 192.168.1.10 --arm ur10e.arm.yaml",
            "palpate view --driver ros --topic /joint_states --arm robot.arm.yaml",
            "palpate view --listen 0.0.0.0:8080",
        ),
    )(run)


def run(
    log: RecordedLog = None,
    arm: ArmOrRecorded = None,
    mass: Annotated[
        float | None,
        typer.Option(
            metavar="KG",
            help="Mass in the simulated hand at the start. [default: the arm's usual one]",
            show_default=False,
        ),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="POSE",
            help="Pose the simulated arm goes to first, a name or angles in rad. [default: the arm's usual one]",
            show_default=False,
        ),
    ] = None,
    noise: Noise = True,
    seed: Seed = 0,
    driver: DriverName = None,
    port: Port = None,
    host: Host = None,
    bus: Bus = None,
    rate: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Rate of a simulated or real arm. [default: 250; 500 for ur and fri]",
            show_default=False,
        ),
    ] = None,
    topic: Topic = None,
    states: States = None,
    stamp: Stamp = None,
    columns: Columns = None,
    effort: Effort = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for recordings.")] = Path(),
    listen: Annotated[
        str,
        typer.Option(
            metavar="[HOST:]PORT",
            help="Where the page is served; 0 takes any free port. Everybody who reaches it can move the arm.",
        ),
    ] = "127.0.0.1:8080",
    meshes: Annotated[
        bool, typer.Option("--meshes", help="Draw the description's meshes where their files are found.")
    ] = False,
    browser: Annotated[
        bool, typer.Option("--open", help="Open the page in this computer's browser.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """View."""
    from .. import weigh as weighing
    from ..view import Page, WatchedArm
    from ._live import interruptible

    if log is not None:
        a_log(log)
        only("a simulation", "LOG is a recording", {"--mass": mass, "--pose": pose})
        only("a live arm", "LOG is a recording", {"--driver": driver, "--rate": rate})
    else:
        only("a LOG", "nothing is recorded yet", {"--columns": columns})
        if driver != "ros":
            only("a LOG or --driver ros", "it is neither", {"--effort": effort})
    if driver != "ros":
        only("--driver ros", "it is not given", {"--topic": topic, "--states": states, "--stamp": stamp})
    on_line = {"--port": port, "--bus": bus, "--host": host}
    if driver is None:
        only("a real arm", "there is no --driver", on_line)
    elif driver == "ros":
        only("an arm on a line of its own", "a ROS 2 graph has topics", on_line)
    if driver is not None:
        only("a simulation", "the arm is real", {"--mass": mass, "--pose": pose})
    host, number = address(listen)
    source: Source
    if log is not None:
        source = _recording(log, arm, columns, base=base, tip=tip, repair=repair, effort=effort)
    elif driver is not None:
        if arm is None:
            raise InputError("--driver needs --arm: which arm is it?")
        model = open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
        if driver == "ros":
            watcher = make_watcher(model, topic=topic, states=states, stamp=stamp, rate=rate)
            source = WatchedArm(watcher, weighing.scene(model), out=make_folder(out))
        else:
            hardware = make_driver(driver, model, port=port, bus=bus, host=host, rate=rate)
            source = _real(model, hardware, out)
    else:
        model = open_arm(arm or DEFAULT_ARM, base=base, tip=tip, repair=repair)
        source = _simulated(model, mass, pose, 250.0 if rate is None else rate, noise, seed, out)
    page = Page(source, host=host, port=number, title=source.arms[0].name, meshes=meshes)
    try:
        source.start()
        if json:
            emit({"url": page.url, "arms": [shown.name for shown in source.arms]})
        else:
            say(page.url if quiet else f"{page.url}   Ctrl-C ends")
            if not quiet and not _is_loopback(host):
                say(f"! Everybody who reaches {host} can see this page and use what is on it.")
        if browser:
            webbrowser.open(page.url)
        with interruptible() as stopped:
            page.run(stopped)
    finally:
        source.stop()
        page.close()
    return 0


def address(text: str) -> tuple[str, int]:
    """Host and port of ``[HOST:]PORT``.

    Raises:
        InputError: something else.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    if not port.isdecimal() or int(port) > 65535:
        raise InputError(f"--listen: expected PORT or HOST:PORT such as 8081 or 0.0.0.0:8080, got {text!r}")
    return host, int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _recording(
    log: Path,
    arm: str | None,
    columns: str | None,
    *,
    base: str | None,
    tip: str | None,
    repair: bool,
    effort: str | None,
) -> Source:
    from ..view import Recording

    model = None if arm is None else open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
    return Recording(open_log(log, columns), model)


def _real(model: Arm, hardware: Driver, out: Path) -> Source:
    from .. import weigh as weighing
    from ..view import RealArm

    hardware.connect()  # only then it says what its effort is
    try:
        return RealArm(hardware, weighing.scene(weighing.driven_arm(model, hardware)), out=make_folder(out))
    except BaseException:
        hardware.close()
        raise


def _simulated(
    model: Arm, mass: float | None, pose: str | None, rate: float, noise: bool, seed: int, out: Path
) -> Source:
    from .. import weigh as weighing
    from ..view import SimulatedArm

    if mass is not None:
        weighing.check_mass(mass)
    scene = weighing.scene(model, mass=mass)
    name, goal = weighing.find_pose(scene, pose or scene.pose)
    start = scene.poses[scene.start]
    task = weighing.Task(scene=scene, start=start, poses=(goal,), rate=rate, noise=noise, seed=seed)
    held = scene.mass if mass is None else mass
    source = SimulatedArm(weighing.simulated_driver(task), scene, out=make_folder(out), mass=held)
    source.send(name)
    return source
