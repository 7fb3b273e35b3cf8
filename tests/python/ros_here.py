"""A corner of the ROS graph for one test process: its own domain and tag, and loopback alone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import palpate
from palpate.ros import Context, Node

DOMAIN = 1 + os.getpid() % 100  # beyond 101 the ports of DDS lie among those that the system gives away
TAGGED = f'<CycloneDDS><Domain Id="any"><Discovery><Tag>palpate-{os.getpid()}</Tag></Discovery></Domain></CycloneDDS>'
"""participants of other tags do not exist; Fast DDS and RustDDS know no tags"""
PATIENCE = 120.0
"""longest wait for something that must happen [s]; a loaded machine may take its time"""


def here() -> Context:
    """A context of this test process."""
    return Context(DOMAIN, localhost=True)


def until(nodes: list[Node], done: Callable[[], Any], what: str) -> None:
    """Let the nodes work until it is done."""
    from palpate.ros.node import together

    assert together(nodes, lambda: bool(done()), PATIENCE), (
        f"waited {PATIENCE:g} s for {what}: {[n.troubles for n in nodes]}"
    )


def palpate_ros(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    """``palpate ros ...`` in a process of its own, in this corner."""
    environment = {**os.environ, "PYTHONPATH": str(Path(palpate.__file__).parents[1])}
    return subprocess.Popen(
        [sys.executable, "-m", "palpate.cli", "ros", *arguments],
        **{
            "env": environment,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.STDOUT,
            "text": True,
            **options,
        },
    )
