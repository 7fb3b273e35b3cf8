"""The live table, and Ctrl-C that lets the arm stop first."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

from ._common import console, mass_text, status_words

if TYPE_CHECKING:
    from rich.console import RenderableType

    from ..weigh import Moment, Task


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """A function that tells whether Ctrl-C was pressed; the second press ends the program at once."""
    pressed = False
    if threading.current_thread() is not threading.main_thread():  # only there can signals be caught
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)


class LiveTable:
    """Mass, status and joints while they change.

    Args:
        task: what the arm does.
        pose: name of the pose it goes to.
    """

    def __init__(self, task: Task, pose: str) -> None:
        from rich.live import Live

        self._task, self._pose = task, pose
        self._live = Live(console=console(), auto_refresh=False, transient=True)

    def __enter__(self) -> LiveTable:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def update(self, moment: Moment) -> None:
        """Show this moment."""
        self._live.update(self._page(moment), refresh=True)

    def _page(self, moment: Moment) -> RenderableType:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        task, touch = self._task, moment.touch
        arm, payload, external = task.scene.arm, touch.payload, touch.external
        good = payload.status.name == "ok"
        head = Table.grid(padding=(0, 2))
        head.add_column(style="dim", no_wrap=True, width=7)
        head.add_column()
        mass = Text(mass_text(payload.mass, payload.mass_std), style="bold" if good else "dim")
        head.add_row("mass", mass.append(" (95 %)", style="dim"))
        status = Text(payload.status.name, style="green" if good else "yellow")
        head.add_row("status", status.append(f": {status_words(payload.status)}", style=""))
        head.add_row(
            "pose", self._pose + ("" if moment.control.name == "ok" else ", held back by a torque limit")
        )
        bar = Table.grid(padding=(0, 2))
        bar.add_row(
            f"{moment.time:.1f} of {task.duration:g} s",
            ProgressBar(total=task.duration, completed=min(moment.time, task.duration), width=30),
        )
        head.add_row("time", bar)

        joints = Table(box=None, padding=(0, 2), header_style="dim")
        joints.add_column("joint", style="dim")
        for name in ("position rad", "wanted rad", "external torque N m"):
            joints.add_column(name, justify="right")
        known = external.status.name == "ok"
        for i, joint in enumerate(arm.joints):
            torque = f"{external.torque[i]:+.2f} ± {1.96 * external.std[i]:.2f}" if known else "-"
            joints.add_row(joint.name, f"{touch.q[i]:+.3f}", f"{moment.setpoint.q[i]:+.3f}", torque)
        return Group(Text(f"{arm.name} lifts an object", style="bold"), head, Text(), joints)
