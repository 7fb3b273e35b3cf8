"""Several nodes as processes of their own: started together, stopped together, started anew if asked."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence

from ..errors import InputError, suggest
from .graphs import GRAPHS, TASKS

_PATIENCE = 5.0
"""for a process to end after it was asked to [s]"""
_RESTARTS = 5
"""of one node within a minute, then it is given up"""
_LOOK = 0.05
"""[s]"""


def graph(name: str, without: Sequence[str] = ()) -> tuple[str, ...]:
    """The nodes of a graph, but for some.

    Raises:
        InputError: no such graph, or no such node in it, or none is left.
    """
    if name not in GRAPHS:
        raise InputError(f"no graph {name!r}; {suggest(name, GRAPHS, 'there is')}")
    nodes = GRAPHS[name]
    for node in without:
        if node not in nodes:
            raise InputError(f"no node {node!r} in {name}; {suggest(node, nodes, 'there are')}")
    left = tuple(node for node in nodes if node not in without)
    if not left:
        raise InputError(f"{name} without all of its nodes is nothing")
    return left


class Launch:
    """Processes of nodes, each ``palpate ros run NODE``.

    Where ``arm_simulation`` is among them, it waits for the others, and all take what its description leaves open as it
    does; when it has done its ``duration``, or ``wipe`` its job, all are stopped.

    Args:
        nodes: names of tasks.
        arguments: ROS arguments, given to every node.
        options: of ``palpate ros run``, given to every node.
        restart: start a node anew that ends by itself.
        say: told what happens, one line each.
    """

    def __init__(
        self,
        nodes: Sequence[str],
        arguments: Sequence[str] = (),
        options: Sequence[str] = (),
        *,
        restart: bool = False,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.nodes = tuple(nodes)
        self._arguments, self._options = list(arguments), list(options)
        self._restart, self._say = restart, say
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._starts: dict[str, list[float]] = {name: [] for name in self.nodes}

    @property
    def pids(self) -> Mapping[str, int]:
        """Process of each node."""
        return {name: process.pid for name, process in self._processes.items()}

    def start(self) -> None:
        """Start all."""
        for name in self.nodes:
            self._start(name)

    def _start(self, name: str) -> None:
        arguments = list(self._arguments)
        if "arm_simulation" in self.nodes:
            readers = sum(TASKS[node].reads_samples for node in self.nodes)
            own = ["-p", "assume:=true"] + (
                ["-p", f"wait_for:={readers}"] if name == "arm_simulation" else []
            )
            arguments = ["--ros-args", *own, "--", *arguments]  # in front: what the user says wins
        command = [sys.executable, "-m", "palpate.cli", "ros", "run", name]
        command += [*self._options, "--parent", str(os.getpid()), *arguments]
        self._starts[name].append(time.monotonic())
        # a session of its own: Ctrl-C reaches this process alone, which stops the others in order
        self._processes[name] = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        )

    def watch(self, stop: Callable[[], bool] = lambda: False) -> int:
        """Keep an eye on them until `stop()`, until a simulated arm is done, or until one fails; then stop all.

        Returns:
            0, or the exit code of the node that failed.
        """
        try:
            while not stop():
                for name, process in list(self._processes.items()):
                    code = process.poll()
                    if code is None:
                        continue
                    if TASKS[name].simulated and code == 0:
                        self._say(f"{name} is done")
                        return 0
                    how = f"ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
                    if not self._restart or code == 2:  # wrong input stays wrong
                        self._say(f"{name} {how}: stopping all")
                        return code if code > 0 else 1
                    recent = [t for t in self._starts[name] if time.monotonic() - t < 60.0]
                    if len(recent) > _RESTARTS:
                        self._say(f"{name} {how}, {len(recent)} times within a minute: stopping all")
                        return code if code > 0 else 1
                    self._say(f"{name} {how}: starting it anew")
                    self._start(name)
                time.sleep(_LOOK)
            return 0
        finally:
            self.stop()

    def stop(self) -> None:
        """Ask all to end, then make them."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [p for p in self._processes.values() if p.poll() is None]
            for process in running:
                process.send_signal(number)
            end = time.monotonic() + _PATIENCE
            for process in running:
                try:
                    process.wait(max(end - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    continue
        self._processes.clear()
