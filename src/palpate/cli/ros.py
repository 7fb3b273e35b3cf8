"""``palpate ros``: nodes of a ROS 2 graph, without a ROS installation."""

from __future__ import annotations

import json as json_module
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError, suggest
from . import STOPPED
from ._common import Json, Quiet, emit, examples, group, say
from ._live import interruptible

if TYPE_CHECKING:
    from ..ros import Context

_ARGUMENTS = {"allow_extra_args": True, "ignore_unknown_options": True}

Domain = Annotated[
    int | None,
    typer.Option(metavar="N", help="Domain. [default: ROS_DOMAIN_ID, or 0]", show_default=False),
]
Localhost = Annotated[
    bool,
    typer.Option(
        "--localhost",
        help="Stay on this machine; so do ROS_LOCALHOST_ONLY=1 and ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.",
    ),
]

RmwOption = Annotated[
    str | None,
    typer.Option(
        metavar="RMW",
        help="What carries messages: dds or zenoh. [default: zenoh if RMW_IMPLEMENTATION is rmw_zenoh_cpp, else dds]",
        show_default=False,
    ),
]


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    ros = group(
        app, "ros", "ROS 2 nodes: the published graph, bridges, a look at what is there. Needs no ROS."
    )
    ros.command(
        "run",
        context_settings=_ARGUMENTS,
        help="Run one node until Ctrl-C.\n\n"
        "Remapping and parameters are given as to any ROS node: "
        "--ros-args -r old:=new -p name:=value --params-file FILE. NODE is one of arm_simulation, trajectory, control, "
        "sliding_mode_observer, extended_kalman_filter, mass, wipe, camera.",
        epilog=examples(
            "palpate ros run mass --ros-args -p arm:=robot.arm.yaml -r joint_states:=/arm/joint_states",
            "palpate ros run mass --ros-args -p arm:=lbr.yaml -p state_kind:=lbr_state -r joint_states:=/lbr/state",
            "palpate ros run arm_simulation --ros-args -p payload_mass:=0.4 -r __ns:=/left",
            "palpate ros run control --domain 7 --ros-args --params-file gains.yaml",
            "palpate ros run mass --rmw zenoh --ros-args -p arm:=robot.arm.yaml",
            "palpate ros run camera --ros-args -p latched:=false -r image/compressed:=/camera/image_raw/compressed",
        ),
    )(run)
    ros.command(
        "launch",
        context_settings=_ARGUMENTS,
        help="Run the nodes of a graph, each in a process of its own, until Ctrl-C.\n\n"
        "GRAPH is mass-estimation: a simulated arm lifts an object, is observed and controlled, and tells its mass on "
        "/payload_mass; or wiping: a simulated arm wipes a whiteboard, and a camera's node judges its pictures.",
        epilog=examples(
            "palpate ros launch mass-estimation",
            "palpate ros launch mass-estimation --ros-args -p arm_simulation:payload_mass:=0.4",
            "palpate ros launch mass-estimation --without arm_simulation --without trajectory --without control "
            "--ros-args -p arm:=robot.arm.yaml",
            "palpate ros launch mass-estimation --restart --ros-args --params-file tuning.yaml",
            "palpate ros launch mass-estimation --rmw zenoh",
            "palpate ros launch wiping --ros-args -p wipe:board:=3",
        ),
    )(launch)
    ros.command(
        "list",
        help="List the nodes and topics of a domain.",
        epilog=examples(
            "palpate ros list", "palpate ros list --domain 7 --json", "palpate ros list --rmw zenoh"
        ),
    )(list_)
    ros.command(
        "echo",
        help="Print what comes on a topic, one JSON object per message.",
        epilog=examples("palpate ros echo /payload_mass", "palpate ros echo /joint_states --count 1"),
    )(echo)


@contextmanager
def _until_asked(parent: int | None = None) -> Iterator[Callable[[], bool]]:
    """A function that tells whether to stop: Ctrl-C, SIGTERM, or the parent process is gone."""
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True

    before = signal.signal(signal.SIGTERM, note)
    try:
        with interruptible() as pressed:
            yield lambda: asked or pressed() or (parent is not None and os.getppid() != parent)
    finally:
        signal.signal(signal.SIGTERM, before)


def run(
    context: typer.Context,
    node: Annotated[str, typer.Argument(metavar="NODE", help="Which one.")],
    domain: Domain = None,
    localhost: Localhost = False,
    rmw: RmwOption = None,
    parent: Annotated[int | None, typer.Option(hidden=True)] = None,
    quiet: Quiet = False,
) -> int:
    """Run one node."""
    from ..ros import RosArguments
    from ..ros.graphs import TASKS

    if node not in TASKS:
        raise InputError(f"no node {node!r}; {suggest(node, TASKS, 'there are')}")
    arguments = RosArguments.parse(context.args)
    with (
        _until_asked(parent) as stop,
        _joined(domain, localhost, rmw, largest=TASKS[node].largest) as there,
        TASKS[node](there, arguments, quiet=quiet) as task,
    ):
        task.log(f"{task.about}; domain {there.domain} over {there.rmw}")
        task.run(stop)
        return 0 if task.finished else STOPPED


def launch(
    context: typer.Context,
    graph: Annotated[str, typer.Argument(metavar="GRAPH", help="Which one: mass-estimation.")],
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="NODE", help="Leave this node out; may be given again.", show_default=False),
    ] = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Start a node anew that ends by itself.")
    ] = False,
    domain: Domain = None,
    localhost: Localhost = False,
    rmw: RmwOption = None,
    quiet: Quiet = False,
) -> int:
    """Launch a graph."""
    from ..ros import RosArguments
    from ..ros.context import check_rmw
    from ..ros.launch import Launch
    from ..ros.launch import graph as nodes_of

    RosArguments.parse(context.args)  # wrong ones are told once, here
    options = [
        *(() if domain is None else ("--domain", str(domain))),
        *(("--localhost",) if localhost else ()),
        *(() if rmw is None else ("--rmw", check_rmw(rmw))),
    ]
    options += ["--quiet"] if quiet else []
    started = Launch(
        nodes_of(graph, without or ()),
        context.args,
        options,
        restart=restart,
        say=(lambda text: None) if quiet else (lambda text: say(f"[launch] {text}")),
    )
    with _until_asked() as stop:
        started.start()
        code = started.watch(stop)
        return STOPPED if stop() and code == 0 else code


def _joined(domain: int | None, localhost: bool, rmw: str | None, **options: Any) -> Context:
    """A member of the graph as the options say."""
    from ..ros import Context
    from ..ros.context import check_rmw

    chosen = None if rmw is None else check_rmw(rmw)
    return Context(domain, localhost=localhost or None, rmw=chosen, **options)


def _look_around(
    domain: int | None, localhost: bool, rmw: str | None, seconds: float
) -> tuple[list[str], dict[str, Any], str]:
    """Nodes, the topics with their types and numbers of publishers and readers, and why there may be none."""
    from ..ros import Node

    with _joined(domain, localhost, rmw) as there, Node("palpate_list", there, quiet=True) as me:
        own = me.full_name
        me.spin_until(lambda: False, seconds)
        nodes = [name for name in there.nodes() if name != own]
        topics: dict[str, Any] = {}
        for what, ends in (("publishers", there.publishers()), ("subscribers", there.subscribers())):
            for end in ends:
                if end.node != own:
                    found = topics.setdefault(end.topic, {"types": [], "publishers": 0, "subscribers": 0})
                    found[what] += 1
                    if end.type not in found["types"]:
                        found["types"].append(end.type)
        alone = there.transport.alone()
    return nodes, dict(sorted(topics.items())), alone


def list_(
    domain: Domain = None,
    localhost: Localhost = False,
    rmw: RmwOption = None,
    wait: Annotated[float, typer.Option(metavar="S", help="How long to look around.")] = 2.0,
    json: Json = False,
) -> int:
    """List nodes and topics."""
    nodes, topics, alone = _look_around(domain, localhost, rmw, wait)
    if json:
        emit({"nodes": nodes, "topics": topics})
        return 0
    say("nodes" if nodes else f"no nodes: is it another domain, or are they on another network?{alone}")
    for name in nodes:
        say(f"  {name}")
    if topics:
        say("topics")
    for name, found in topics.items():
        say(
            f"  {name}  {', '.join(found['types'])}  {found['publishers']} publishing, {found['subscribers']} reading"
        )
    return 0


def echo(
    topic: Annotated[str, typer.Argument(metavar="TOPIC", help="Full name, e.g. /payload_mass.")],
    count: Annotated[int, typer.Option(metavar="N", help="Stop after so many messages; 0: at Ctrl-C.")] = 0,
    domain: Domain = None,
    localhost: Localhost = False,
    rmw: RmwOption = None,
) -> int:
    """Print messages."""
    from ..ros import Node, messages

    known = {m.ros_type: m for m in vars(messages).values() if hasattr(m, "ros_type")}
    printed = 0

    def show(message: Any, writer: int) -> None:
        nonlocal printed
        if not count or printed < count:
            say(json_module.dumps(asdict(message), ensure_ascii=False))
            printed += 1

    with (
        _until_asked() as stop,
        _joined(domain, localhost, rmw) as there,
        Node("palpate_echo", there) as node,
    ):
        full = node.resolve(topic)
        node.spin_until(lambda: stop() or bool(there.publishers(full)))
        types = {end.type for end in there.publishers(full)}
        if not types:
            return STOPPED
        name = min(types)
        if name not in known:
            raise InputError(
                f"{topic} is {name}, which palpate cannot read; it reads {', '.join(sorted(known))}"
            )
        node.subscribe(known[name], topic, show)
        done = node.spin_until(lambda: stop() or (0 < count <= printed))
        return STOPPED if done and stop() else 0
