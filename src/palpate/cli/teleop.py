"""``palpate teleop``: a hand moves a device, an arm follows, and the hand feels what it touches."""

from __future__ import annotations

import math
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import numpy as np
import typer
from typer.core import TyperGroup

from ..errors import InputError, suggest
from . import STOPPED
from ._common import (
    Json,
    Quiet,
    Seed,
    check_target,
    console,
    emit,
    examples,
    is_recording,
    is_report,
    make_folder,
    print_rows,
    say,
)
from ._live import interruptible

VERBS = ("run", "slave", "master", "devices", "key", "join")
VIEW_S = 600.0
"""how long a viewed run is where nobody says [s]"""

if TYPE_CHECKING:
    from ..teleop import CouplingName, Faults, RateMaster, UdpChannel
    from ..teleop.ends import MasterEnd, SlaveEnd
    from ..teleop.masters import Device
    from ..teleop.session import Cut, Run, Tap, Wish
    from ..teleop.setups import Setup


_Key = Annotated[
    Path, typer.Option("--key", metavar="FILE", help="The key that both sides share; see palpate teleop key.")
]
_Coupling = Annotated[
    str,
    typer.Option(
        "--coupling", metavar="NAME", help="force_position (as published), position_position or four_channel."
    ),
]
_Passivity = Annotated[
    bool,
    typer.Option("--passivity/--no-passivity", help="The passivity layer; without it see what delay does."),
]
_Delay = Annotated[float, typer.Option("--delay", metavar="S", help="Of every message, each way.")]
_Jitter = Annotated[
    float,
    typer.Option(
        "--jitter", metavar="S", help="Uniform, on top of the delay; messages overtake one another."
    ),
]
_Loss = Annotated[float, typer.Option("--loss", metavar="P", help="Probability that a message is lost.")]
_Duplicate = Annotated[
    float, typer.Option("--duplicate", metavar="P", help="Probability that a message comes twice.")
]
_Seconds = Annotated[
    float | None,
    typer.Option("--seconds", metavar="S", help="How long. [default: until Ctrl-C]", show_default=False),
]
_Record = Annotated[
    Path | None,
    typer.Option("--record", metavar="FILE", help="Record this side, on its own clock.", show_default=False),
]
_Scene = Annotated[
    str,
    typer.Argument(
        metavar="[SCENE]", help="wall, rigid, surface, peg, lift, turn or free.", show_default=False
    ),
]
_Arm = Annotated[
    str,
    typer.Option(
        "--arm", metavar="ARM", help="The slave: kuka_lbr_iiwa14, kuka_lbr_iiwa7, abb_irb2400_16 or so101."
    ),
]
_Stiffness = Annotated[float, typer.Option("--stiffness", metavar="N/M", help="Of the wall.")]
_MotionScale = Annotated[
    float | None,
    typer.Option(
        "--motion-scale",
        metavar="S",
        help="Motion of the arm per motion of the hand. [default: what suits the arm]",
        show_default=False,
    ),
]
_ForceScale = Annotated[
    float | None,
    typer.Option(
        "--force-scale",
        metavar="S",
        help="Force felt per force touched. [default: what suits the arm]",
        show_default=False,
    ),
]
_Master = Annotated[
    str,
    typer.Option(
        "--master",
        metavar="NAME",
        help="Who moves the arm: hand (simulated, does what the scene asks for), gamepad, spacemouse or keyboard.",
    ),
]
_Device = Annotated[
    str | None,
    typer.Option(
        "--device",
        metavar="PATH",
        help="Which gamepad or SpaceMouse, such as /dev/input/event5; see palpate teleop devices. "
        "[default: the only one]",
        show_default=False,
    ),
]
_Speed = Annotated[
    float | None,
    typer.Option(
        "--speed",
        metavar="M/S",
        help="Of gamepad, spacemouse or keyboard at full deflection, before the motion scale. [default: 0.1]",
        show_default=False,
    ),
]


class _Verbs(TyperGroup):
    """What is no verb is a scene: `palpate teleop wall` is `palpate teleop run wall`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or (args[0] not in self.commands and args[0] not in ("--help", "-h")):
            args = ["run", *args]
        return super().parse_args(ctx, args)


def add(app: typer.Typer) -> None:
    """Make the verbs known."""
    verbs = typer.Typer(
        cls=_Verbs,
        rich_markup_mode=None,
        help="Teleoperate a simulated arm and feel what it touches, without a force sensor.\n\n"
        "Without a verb both sides run in this process: a scripted hand holds a simulated haptic device, the arm "
        "follows it in MuJoCo; see palpate teleop run. With master and slave they are two processes, here or on two "
        "machines.",
        epilog=examples(
            "palpate teleop",
            "palpate teleop wall --stiffness 5000 --delay 0.1 --jitter 0.05 --loss 0.2",
            "palpate teleop key teleop.key",
            "palpate teleop slave wall --key teleop.key --record slave.mcap",
            "palpate teleop master --connect 127.0.0.1:5005 --key teleop.key --record master.mcap",
            "palpate teleop join master.mcap slave.mcap --out teleop.mcap",
        ),
    )
    verbs.command(
        "run",
        help="Both sides in one process.\n\n"
        "Scenes: wall (press a spring of known stiffness), rigid (a wall that gives no way), "
        "surface (trace it), peg (into a hole), lift (objects whose masses nobody knows), turn (a valve on a spring "
        "by a key), free (nothing to touch). "
        "Delay, jitter, loss and dead links come from a fault layer; every message is encrypted and authenticated.",
        epilog=examples(
            "palpate teleop run",
            "palpate teleop run wall --stiffness 5000 --delay 0.1 --jitter 0.05 --loss 0.2",
            "palpate teleop run wall --delay 0.1 --no-passivity",
            "palpate teleop run lift --mass 0.4 --mass 1.5",
            "palpate teleop run wall --cut 5@1.5",
            "palpate teleop run rigid --view",
            "palpate teleop run free --arm so101 --view",
            "palpate teleop run surface --master gamepad --view",
        ),
    )(run)
    verbs.command(
        "slave",
        help="The arm's side, a process of its own: a simulated arm in a scene waits for its master.\n\n"
        "It listens on this machine alone unless --bind says otherwise, and takes nothing that was not sealed with "
        "the key. What holds it is said here, to the master and in the recording.",
        epilog=examples(
            "palpate teleop slave wall --key teleop.key",
            "palpate teleop slave peg --bind 0.0.0.0:5005 --key teleop.key --record slave.mcap",
        ),
    )(slave)
    verbs.command(
        "master",
        help="The hand's side, a process of its own.\n\n"
        "The device is a simulated one in a hand that follows a scene's script, or what a person moves: a gamepad, a "
        "SpaceMouse, the keys of this terminal. These give a speed; the force they cannot give is told, and rumbles.",
        epilog=examples(
            "palpate teleop master --connect 127.0.0.1:5005 --key teleop.key",
            "palpate teleop master --connect 192.168.1.20:5005 --key teleop.key --master keyboard --record master.mcap",
        ),
    )(master)
    verbs.command(
        "devices",
        help="List gamepads and SpaceMice that can be masters, and what to do where there are none.",
        epilog=examples("palpate teleop devices", "palpate teleop devices --json"),
    )(devices)
    verbs.command(
        "key",
        help="Write a new key, readable by you alone; copy it to the other machine by a safe way.",
        epilog=examples("palpate teleop key teleop.key"),
    )(key)
    verbs.command(
        "join",
        help="Make one recording of both sides' on the master's clock.",
        epilog=examples("palpate teleop join master.mcap slave.mcap --out teleop.mcap"),
    )(join)
    app.add_typer(verbs, name="teleop")


def key(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Not there yet: a key is never overwritten.")],
    json: Json = False,
) -> int:
    """Make a key."""
    from ..teleop import make_key

    path = make_key(file)
    emit({"key": str(path)}) if json else say(
        f"{path}: a new key, readable by you alone; both machines need the same"
    )
    return 0


def devices(json: Json = False) -> int:
    """List input devices."""
    from ..teleop.input_devices import KINDS, advice, connected

    found = connected()
    hint = advice(found)
    if json:
        fields = [{"path": f.path, "name": f.name, "kind": f.kind, "problem": f.problem} for f in found]
        emit({"devices": fields, "advice": hint})
        return 0
    shown: list[tuple[str, Any]] = [(f.path, f"{f.kind}: {f.name}") for f in found if f.kind is not None]
    shown += [(f.path, f.problem) for f in found if f.problem]
    print_rows(shown)
    if others := sum(f.kind is None and not f.problem for f in found):
        say(f"{others} other input devices")
    if hint:
        say(hint)
    for kind in KINDS.values():
        say(f"palpate teleop run wall --view --master {kind.name}: {kind.usage}")
    return 0


def join(
    master: Annotated[Path, typer.Argument(metavar="MASTER", help="Recording of the master's side.")],
    slave: Annotated[Path, typer.Argument(metavar="SLAVE", help="And of the slave's.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="What to write.")] = Path(
        "teleop.mcap"
    ),
    json: Json = False,
) -> int:
    """Join two recordings."""
    from ..teleop.node import join_files

    check_target(out, is_recording, "the recording")
    path = join_files(master, slave, out)
    emit({"log": str(path)}) if json else say(str(path))
    return 0


def slave(
    scene: _Scene = "wall",
    key: _Key = Path("teleop.key"),
    bind: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where to listen; port 0 takes any free one.")
    ] = "127.0.0.1:5005",
    arm: _Arm = "kuka_lbr_iiwa14",
    coupling: _Coupling = "force_position",
    stiffness: _Stiffness = 2000.0,
    motion_scale: _MotionScale = None,
    force_scale: _ForceScale = None,
    passivity: _Passivity = True,
    delay: _Delay = 0.0,
    jitter: _Jitter = 0.0,
    loss: _Loss = 0.0,
    duplicate: _Duplicate = 0.0,
    seconds: _Seconds = None,
    seed: Seed = 0,
    record: _Record = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Be the slave."""
    from ..teleop import UdpChannel, read_key
    from ..teleop.ends import SlaveEnd
    from ..teleop.setups import Shared, build_slave

    place = _place(scene)
    _scales(arm, motion_scale, force_scale)
    if scene == "lift":
        raise InputError("the objects of lift come by a script of both sides: palpate teleop run lift")
    faults = _faults(delay, jitter, loss, duplicate)
    channel = UdpChannel(read_key(key), "slave", 6, local=_address("--bind", bind), faults=faults, seed=seed)
    shared = Shared(_coupling(coupling), passivity, session=None)
    follower, side, _, _ = build_slave(
        place,
        arm=arm,
        shared=shared,
        stiffness=stiffness,
        motion_scale=motion_scale,
        force_scale=force_scale,
        seed=seed,
    )
    return _serve(SlaveEnd(follower, side), channel, record, seconds, json=json, quiet=quiet)


def master(
    connect: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where the slave listens.")
    ] = "127.0.0.1:5005",
    key: _Key = Path("teleop.key"),
    master: _Master = "hand",
    device: _Device = None,
    speed: _Speed = None,
    script: Annotated[
        str,
        typer.Option(
            metavar="SCENE", help="What the simulated hand does: wall, rigid, surface, peg, turn, free."
        ),
    ] = "wall",
    bind: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            help="Where to listen for the answers. [default: this machine alone for a slave here, else all]",
            show_default=False,
        ),
    ] = None,
    coupling: _Coupling = "force_position",
    passivity: _Passivity = True,
    delay: _Delay = 0.0,
    jitter: _Jitter = 0.0,
    loss: _Loss = 0.0,
    duplicate: _Duplicate = 0.0,
    seconds: _Seconds = None,
    seed: Seed = 0,
    record: _Record = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Be the master."""
    from ..teleop import HapticDevice, UdpChannel, read_key
    from ..teleop.ends import MasterEnd
    from ..teleop.scenes import find
    from ..teleop.setups import Shared, build_master, scripted

    path = _place(script)
    peer = _address("--connect", connect)
    here = peer[0] in ("127.0.0.1", "localhost")
    local = _address("--bind", bind) if bind is not None else ("127.0.0.1" if here else "0.0.0.0", 0)
    faults = _faults(delay, jitter, loss, duplicate)
    shared = Shared(_coupling(coupling), passivity, session=None)
    with ExitStack() as stack:
        moved = _moved(master, device, speed, stack)
        held: Device | None = moved
        if held is None:
            held = HapticDevice(scripted(None if path is None else find(path, np.zeros(3))))
        channel = UdpChannel(read_key(key), "master", 6, local=local, peer=peer, faults=faults, seed=seed)
        end = MasterEnd(held, build_master(held, shared))
        return _serve(end, channel, record, seconds, moved=moved, json=json, quiet=quiet)


def _place(scene: str) -> str | None:
    """The name of what there is to touch; None: nothing."""
    from ..teleop.scenes import SceneName

    names = (*get_args(SceneName), "free")
    if scene not in names:
        close = suggest(scene, (*names, *VERBS), f"scenes are {', '.join(names)}; verbs")
        raise InputError(f"no scene and no verb {scene!r}; {close}")
    return None if scene == "free" else scene


def _scales(arm: str, motion: float | None, force: float | None) -> None:
    """Whether these can be had."""
    from ..teleop.scenes import slave_arm

    twins = slave_arm(arm).kind == "servos"
    for option, value in (("--motion-scale", motion), ("--force-scale", force)):
        if value is None:
            continue
        if twins:
            raise InputError(f"{option}: {arm} is led joint by joint by its twin, one to one")
        if not 0.0 < value < math.inf:
            raise InputError(f"{option}: expected a number above 0, got {value:g}")


def _moved(master: str, device: str | None, speed: float | None, stack: ExitStack) -> RateMaster | None:
    """What a person moves, closed with the stack; None: the simulated hand does."""
    from ..teleop import InputSource, RateMaster, TerminalKeys
    from ..teleop.input_devices import KINDS
    from ..teleop.rate_control import Source

    names = ("hand", *KINDS, "keyboard")
    if master not in names:
        raise InputError(f"--master: {suggest(master, names, 'expected one of')} got {master!r}")
    if device is not None and master not in KINDS:
        raise InputError(
            f"--device says which gamepad or spacemouse; --master {master} has none to choose from"
        )
    if master == "hand":
        if speed is not None:
            raise InputError(
                "--speed is for gamepad, spacemouse or keyboard; the hand is as fast as its scene"
            )
        return None
    if speed is not None and not 0.0 < speed <= 1.0:
        raise InputError(f"--speed: expected above 0 to 1 m/s, got {speed!r}")
    source: Source = (
        stack.enter_context(TerminalKeys()) if master == "keyboard" else InputSource(master, device)
    )
    found = RateMaster(source) if speed is None else RateMaster(source, speed=speed)
    stack.callback(found.close)
    return found


def _serve(
    end: MasterEnd | SlaveEnd,
    channel: UdpChannel,
    record: Path | None,
    seconds: float | None,
    *,
    moved: RateMaster | None = None,
    json: bool,
    quiet: bool,
) -> int:
    """Run one side until Ctrl-C or the end; a line per second, and one whenever something holds it."""
    from ..teleop.node import Node

    if record is not None:
        check_target(record, is_recording, "the recording")
    role, (host, port) = channel.sealer.role, channel.address

    def line(text: str) -> None:
        if not (json or quiet):
            say(text)
            sys.stdout.flush()

    if json:
        emit({"role": role, "host": host, "port": port})
    else:
        say(f"{role} at {host}:{port}   Ctrl-C ends")
        if moved is not None:
            say(f"{moved.source.name}: {moved.source.usage}")
    sys.stdout.flush()
    node = Node(end, channel, record=record, tell=lambda reason: line(f"! {reason or 'free again'}"))
    try:
        with interruptible() as stopped:
            node.run(
                stopped,
                seconds=math.inf if seconds is None else seconds,
                show=lambda state: line(f"{state}{_waits(moved)}"),
            )
            ended = stopped() and seconds is not None
    finally:
        node.close()
    state = node.state()
    if json:
        emit({"gain": state.gain, "reason": state.reason, "refused": dict(state.refused), "loss": state.loss})
    return STOPPED if ended else 0


def _waits(moved: RateMaster | None) -> str:
    """What a person sees of what he moves, behind the state of the link."""
    if moved is None:
        return ""
    return f"; felt {moved.felt:.1f} N" + (f"; {moved.status}" if moved.status else "")


def _address(option: str, text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"{option}: expected HOST:PORT such as 127.0.0.1:5005, got {text!r}")
    return host, int(port)


def _faults(delay: float, jitter: float, loss: float, duplicate: float) -> Faults | None:
    from ..teleop.channel import Faults

    found = Faults(delay=delay, jitter=jitter, loss=loss, duplicate=duplicate)
    return None if found == Faults() else found


def _coupling(name: str) -> CouplingName:
    from ..teleop.coupling import COUPLINGS

    if name not in COUPLINGS:
        raise InputError(f"--coupling: expected {', '.join(COUPLINGS)}, got {name!r}")
    return name


def run(
    scene: _Scene = "wall",
    arm: _Arm = "kuka_lbr_iiwa14",
    master: _Master = "hand",
    device: _Device = None,
    speed: _Speed = None,
    coupling: _Coupling = "force_position",
    stiffness: _Stiffness = 2000.0,
    press: Annotated[
        float, typer.Option(metavar="M", help="How far behind wall or surface the hand goes.")
    ] = 0.02,
    mass: Annotated[
        list[float] | None,
        typer.Option(
            metavar="KG",
            help="Object to lift; again for the next one. [default: what suits the arm]",
            show_default=False,
        ),
    ] = None,
    motion_scale: _MotionScale = None,
    force_scale: _ForceScale = None,
    torque: Annotated[
        float | None,
        typer.Option(
            metavar="NM",
            help="Largest torque of the device; 0: its gimbal is measured and has no motors. [default: 0.5 in turn, "
            "else 0]",
            show_default=False,
        ),
    ] = None,
    delay: _Delay = 0.0,
    jitter: _Jitter = 0.0,
    loss: _Loss = 0.0,
    duplicate: _Duplicate = 0.0,
    cut: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AT@FOR",
            help="The link dies at a time, for so long [s]; again for the next.",
            show_default=False,
        ),
    ] = None,
    passivity: _Passivity = True,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="How long. [default: as long as the scene takes]", show_default=False),
    ] = None,
    seed: Seed = 0,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for report.html and teleop.mcap.")
    ] = Path("teleop"),
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    record: Annotated[
        bool, typer.Option("--record/--no-record", help="Write teleop.mcap, both sides in one log.")
    ] = True,
    view: Annotated[
        bool, typer.Option("--view", help="A live page: both arms, forces, and the network to be made worse.")
    ] = False,
    listen: Annotated[
        str, typer.Option(metavar="[HOST:]PORT", help="Where the page is served; 0 takes any free port.")
    ] = "127.0.0.1:8080",
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Teleoperate."""
    from ..teleop.record import record as write_log
    from ..teleop.record import rows, write_report
    from ..teleop.setups import build

    place, chosen = _place(scene), _coupling(coupling)
    _scales(arm, motion_scale, force_scale)
    if mass and scene != "lift":
        raise InputError(f"--mass is for the scene lift, and this is {scene}")
    if torque is not None and (master != "hand" or not 0.0 <= torque < math.inf):
        raise InputError(
            f"--torque: expected 0 N m or more of the simulated device (--master hand), got {torque:g}"
        )
    faults = _faults(delay, jitter, loss, duplicate)
    cuts = tuple(map(_cut, cut or ()))
    page, log = out / "report.html", out / "teleop.mcap"
    if report or record:
        make_folder(out)
        check_target(page, is_report, "the report")
        check_target(log, is_recording, "the recording")
    options: dict[str, Any] = {}
    with ExitStack() as stack:
        moved = _moved(master, device, speed, stack)
        setup = build(
            place,
            arm=arm,
            coupling=chosen,
            stiffness=stiffness,
            press=press,
            masses=tuple(mass) if mass else None,
            motion_scale=motion_scale,
            force_scale=force_scale,
            torque_limit=torque,
            device=moved,
            passive=passivity,
            seed=seed,
        )
        live = view or moved is not None
        length = VIEW_S if live and seconds is None else seconds
        stopped = stack.enter_context(interruptible())
        if view:
            options["tap"] = _page(setup, faults, listen, stack, VIEW_S if length is None else length)
        elif moved is not None:
            pilot = stack.enter_context(_Pilot(moved, faults, silent=json or quiet))
            options["tap"] = pilot.tap
        bar = stack.enter_context(_Bar(silent=json or quiet or live))
        result = setup.run(
            seconds=length, faults=faults, cuts=cuts, progress=bar, seed=seed, stop=stopped, **options
        )
        ended = stopped() and not live
    files: dict[str, str] = {}
    settings: dict[str, object] = {
        "scene": scene,
        "arm": arm,
        "master": master if moved is None else f"{master}, {moved.source.name}",
        "coupling": coupling,
        "passivity layer": "on" if passivity else "off",
        "motion scale": setup.motion_scale,
        "force scale": setup.follower.force_scale,
        "delay, jitter [s]": f"{delay:g}, {jitter:g}",
        "loss, duplicates": f"{loss:g}, {duplicate:g}",
        "dead links": ", ".join(f"{c.at:g} s for {c.seconds:g} s" for c in cuts) or "none",
        "seed": seed,
    }
    if report:
        files["report"] = str(write_report(result, setup, page, settings=settings, cuts=cuts))
    if record:
        files["log"] = str(write_log(result, setup, log, overwrite=True))
    found = rows(result, setup, cuts)
    if json:
        emit(
            {
                "settings": settings,
                "rows": [{"what": r.what, "value": r.ours, "unit": r.unit, "note": r.note} for r in found],
                "reasons": [{"time_s": t, "text": text} for t, text in result.reasons],
                "refused": result.refused,
                "files": files,
            }
        )
    elif quiet:
        for r in found:
            say(f"{r.what}: {r.ours:.4g} {r.unit}")
    else:
        head: list[tuple[str, Any]] = [("scene", "free motion" if setup.scene is None else setup.scene.text)]
        head += [(r.what, f"{r.ours:.3g} {r.unit}" + (f"  ({r.note})" if r.note else "")) for r in found]
        head += list(files.items())
        print_rows(head, [f"at {t:.2f} s: {text}" for t, text in result.reasons])
    return STOPPED if ended else 0


def _page(setup: Setup, faults: Faults | None, listen: str, stack: ExitStack, seconds: float) -> Tap:
    """A live page of what runs, closed with the stack; its tap."""
    from ..view.teleop import TeleopPage, take_over
    from .view import address

    host, port = address(listen)
    person = take_over(setup)
    page = TeleopPage(setup, person=person, faults=faults, host=host, port=port)
    stack.callback(page.close)
    say(f"{page.url}   Ctrl-C ends, and so do {seconds:g} s")
    sys.stdout.flush()
    return page.tap


def _cut(text: str) -> Cut:
    from ..teleop.session import Cut

    at, _, length = text.partition("@")
    try:
        found = Cut(float(at), float(length))
    except ValueError:
        raise InputError(f"--cut: expected AT@FOR in seconds, such as 5@1.5, got {text!r}") from None
    if not (found.at >= 0.0 and 0.0 < found.seconds <= 3600.0):
        raise InputError(f"--cut: expected a time >= 0 and a length above 0 to 3600 s, got {text!r}")
    return found


class _Line:
    """A line of the terminal that tells how it goes until the end; nothing where there is no terminal."""

    _status: Any = None

    def _begin_line(self) -> None:
        if console().is_terminal:
            self._status = console().status("starting")
            self._status.start()

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()


class _Pilot(_Line):
    """Real time for a person without a page: where the arm is and what it feels, in one line of the terminal."""

    def __init__(self, moved: RateMaster, faults: Faults | None, *, silent: bool) -> None:
        from ..teleop import Faults
        from ..teleop.pace import Pace
        from ..teleop.session import Wish

        self._moved, self._silent, self._pace = moved, silent, Pace()
        self._wish = Wish(faults or Faults())
        self._said = ""

    def __enter__(self) -> _Pilot:
        if not self._silent:
            say(f"{self._moved.source.name}: {self._moved.source.usage}   Ctrl-C ends")
            sys.stdout.flush()
            self._begin_line()
        return self

    def tap(self, k: int, run: Run) -> Wish:
        """At the end of every period."""
        self._pace.wait(k)
        if k % 100 == 0 and not self._silent:
            reason = run.reasons[-1][1] if run.holding else ""
            if reason != self._said:
                self._said = reason
                say(f"! {reason or 'free again'}")
                sys.stdout.flush()
            if self._status is not None:
                x, y, z = 1e3 * (run.tip[k] - run.tip[0])
                felt = float(np.linalg.norm(run.felt[k]))
                self._status.update(
                    f"{run.time[k]:.0f} s   arm {x:+.0f} {y:+.0f} {z:+.0f} mm   felt {felt:.1f} N   "
                    f"{reason or self._moved.status or 'moves'}"
                )
        return self._wish


class _Bar(_Line):
    """How far the simulation is and when it will be done; without a terminal a line on stderr every half minute."""

    def __init__(self, *, silent: bool) -> None:
        self._silent = silent
        self._begin = self._told = time.monotonic()

    def __enter__(self) -> _Bar:
        if not self._silent:
            self._begin_line()
        return self

    def __call__(self, done: float, whole: float) -> None:
        spent = time.monotonic() - self._begin
        text = f"{done:.1f} of {whole:g} s simulated, {spent * (whole - done) / max(done, 1e-9):.0f} s left"
        if self._status is not None:
            self._status.update(text)
        elif not self._silent and time.monotonic() - self._told >= 30.0:
            self._told = time.monotonic()
            sys.stderr.write(text + "\n")
