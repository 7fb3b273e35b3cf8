"""The live page of a teleoperator: device and arm in 3-D, forces felt and true, a network to be made worse."""

from __future__ import annotations

import contextlib
import io
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .._core import rotation_matrix, turn_between
from ..arm import Array
from ..report._style import LIGHT
from ..report._text import escape
from ..teleop.channel import Faults
from ..teleop.coupling import Event, event_words
from ..teleop.ends import PERIOD
from ..teleop.masters import HapticDevice
from ..teleop.pace import Pace
from ..teleop.rate_control import RateMaster
from ..teleop.scenes import smooth
from ..teleop.servo_arms import ServoSlave, SimulatedLeader
from ..teleop.session import Run, Wish
from ..teleop.setups import Setup
from ._guard import guarded
from .page import _STYLE, PLOT_AXES, _drawn, _no_share, _viser, _wxyz, check_address, look
from .scene import link_frames

if TYPE_CHECKING:
    from viser import ViserServer

    from ..arm import Arm

Arrow: TypeAlias = tuple[Array, Array]
"""where a force acts (3,) [m], and the force (3,) [N]"""

FPS = 15.0
"""updates of the page per second [Hz]"""
_SPAN_S = 10.0
"""how far back the curves go [s]"""
_POINTS = 500
_NEWTONS = 0.02
"""length of an arrow [m/N]"""
_ASIDE = np.array([0.0, -0.7, 0.0])
"""where the device is drawn, from the tool's place at the start [m]"""
_BESIDE = np.array([0.0, -0.45, 0.0])
"""where the base of a leader arm is drawn, from that of its twin [m]"""
_TURN_DEG = 30.0
"""how far a slider turns a joint of the leader to each side [degrees]"""
_TAKE_OVER_S = 1.5
"""over which a hand goes from the script to the sliders and back [s]"""
_TRUE, _FELT, _ESTIMATED = LIGHT["ink"], LIGHT["red"], LIGHT["blue"]


class Person:
    """A wish for the hand that a page can take over from the script, without a jump.

    Args:
        script: where the hand wants to be at a time [s], (n,) [m], or [rad] at the joints of a leader; begins anew
            after `seconds`.
        seconds: how long the script is [s].
    """

    def __init__(self, script: Callable[[float], Array], seconds: float) -> None:
        self._script, self._seconds = script, seconds
        self._rest = np.asarray(script(0.0), dtype=np.float64)
        self._place = self._from = self._rest
        self._since, self._own = -math.inf, False
        self._now = 0.0

    def __call__(self, time: float) -> Array:
        """(n,) where the hand wants to be [m, rad]."""
        self._now = time
        wanted = self._place if self._own else np.asarray(self._script(math.fmod(time, self._seconds)))
        part = smooth((time - self._since) / _TAKE_OVER_S)
        found: Array = self._from + part * (wanted - self._from)
        return found

    def go(self, away: Array | None) -> None:
        """From now on this far (n,) from where the script begins [m, rad]; None: the script's."""
        self._from, self._since = self(self._now), self._now
        self._own = away is not None
        self._place = self._rest if away is None else self._rest + away


def take_over(setup: Setup) -> Person | None:
    """A person at the page may take the simulated hand over; None: a person moves the device already."""
    device = setup.device
    if not isinstance(device, HapticDevice | SimulatedLeader):
        return None
    person = Person(device.hand.wish, setup.seconds)
    device.hand = replace(device.hand, wish=person)
    return person


class _Handle:
    """A device that points in three axes, as a handle in a box beside the slave."""

    what, unit = "Force on the tool", "N"

    def __init__(self, scene: Any, setup: Setup) -> None:
        self._setup, self.tip = setup, setup.slave.x
        self._place = self.tip + _ASIDE
        scene.add_box(
            "/device/space",
            dimensions=(0.6, 0.6, 0.6),
            position=self._place,
            color=(200, 208, 216),
            opacity=0.12,
        )
        self._handle = scene.add_icosphere("/device/handle", radius=0.02, color=(0, 114, 178))
        self._stylus = scene.add_frame("/device/stylus", axes_length=0.08, axes_radius=0.003)
        scene.add_label("/device/name", "device", position=self._place + np.array([0.0, 0.0, 0.34]))
        scene.add_label("/slave/name", "slave", position=(0.0, 0.0, 1.3))
        self.view = (
            self.tip + np.array([1.1, -1.7, 0.7]),
            self.tip + 0.4 * _ASIDE - np.array([0.15, 0.0, 0.05]),
        )

    def move(self, run: Run, k: int) -> tuple[Array, Arrow, Arrow]:
        """Where the slave is to go (3,) [m], true and felt force as arrows."""
        place = self._place + run.device[k]
        self._handle.position = self._stylus.position = place
        self._stylus.wxyz = _wxyz(rotation_matrix(run.device_turn[k]))
        goal = self.tip + self._setup.motion_scale * (run.device[k] - run.device[0])
        scale = self._setup.follower.force_scale
        return goal, (run.tip[k], run.true[k]), (place, run.felt[k] / scale)


class _Leader:
    """A leader arm beside its twin; what the joints feel is drawn as the force at the tip that does the same."""

    what, unit = "Torque on the joints", "N m"

    def __init__(self, scene: Any, slave: ServoSlave) -> None:
        self._slave, arm = slave, slave.model
        self.tip = slave.x
        places = [f"/leader/link{i}" for i in range(arm.n + 1)]
        self._frames = [scene.add_frame(place, show_axes=False) for place in places]
        for _, handle, colour in _drawn(scene, places, arm, False):
            handle.color = tuple(
                round(0.5 * (part + 255)) for part in colour
            )  # paler than the one that touches
        top = np.array([0.0, 0.0, 0.36])
        scene.add_label("/leader/name", "leader", position=_BESIDE + top)
        scene.add_label("/slave/name", "follower", position=top)
        middle = 0.5 * (self.tip + _BESIDE)
        self.view = middle + np.array([0.72, -0.72, 0.48]), middle

    def move(self, run: Run, k: int) -> tuple[Array, Arrow, Arrow]:
        """Where the follower's tip is to go (3,) [m], true and felt force as arrows."""
        slave, leader = self._slave, run.device[k]
        _place(self._frames, slave.model, leader, _BESIDE)
        goal = slave.tip(leader)
        return (
            goal,
            (slave.tip(run.tip[k]), slave.at_tip(run.tip[k], run.true[k])),
            (_BESIDE + goal, slave.at_tip(leader, run.felt[k])),
        )


def _place(frames: list[Any], arm: Arm, q: Array, base: Array) -> None:
    """Put an arm's links where they are, its base at `base` (3,) [m]."""
    for handle, T in zip(frames, link_frames(arm, q), strict=True):
        handle.wxyz, handle.position = _wxyz(T[:3, :3]), base + T[:3, 3]


class TeleopPage:
    """Shows a run while it goes on. Give :meth:`tap` to it; in real time, or slower where the computer is.

    Args:
        setup: what runs.
        person: the hand's wish, see :func:`take_over`; None: it cannot be taken over.
        faults: of the network at the start.
        host: address to listen at.
        port: 0: any free one.

    Raises:
        InputError: the address is taken.
        MissingExtraError: viser is not installed.
    """

    def __init__(
        self,
        setup: Setup,
        *,
        person: Person | None = None,
        faults: Faults | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        viser = _viser()
        check_address(host, port)
        with contextlib.redirect_stdout(io.StringIO()), guarded(host):  # it greets with a table of its own
            self._server: ViserServer = viser.ViserServer(
                host=host, port=port, label="palpate teleop", verbose=False
            )
        vars(self._server)["request_share_url"] = _no_share
        self.url = f"http://{host}:{self._server.get_port()}"
        self.faults, self.cut = faults or Faults(), False
        """what the network does now; set by the page"""
        self.closed = True
        """the clutch; set by the page"""
        self._setup, self._person = setup, person
        self._run: tuple[Run, int] | None = None
        self._pace = Pace()
        self._over = threading.Event()
        self.frames = 0
        """updates made so far"""
        self._build_scene()
        self._build_controls()
        self._thread = threading.Thread(target=self._show, daemon=True)
        self._thread.start()

    # --- building ------------------------------------------------------------------------------------------------

    def _build_scene(self) -> None:
        server, arm = self._server, self._setup.slave.model
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        server.scene.configure_default_lights(enabled=True, cast_shadow=False)
        server.scene.add_grid("/floor", width=4.0, height=4.0, cell_size=0.1, section_size=0.5)
        places = [f"/slave/link{i}" for i in range(arm.n + 1)]
        self._frames = [server.scene.add_frame(place, show_axes=False) for place in places]
        self._shapes = [handle for _, handle, _ in _drawn(server.scene, places, arm, False)]
        slave = self._setup.slave
        self._master = (
            _Leader(server.scene, slave)
            if isinstance(slave, ServoSlave)
            else _Handle(server.scene, self._setup)
        )
        self._goal = server.scene.add_icosphere("/goal", radius=0.018, color=(0, 114, 178), opacity=0.35)
        self._boxes = self._touched()
        self._arrows = {
            name: server.scene.add_line_segments(
                f"/force/{name}",
                points=np.zeros((1, 2, 3)),
                colors=colour,
                thickness=5.0,
                thickness_units="screen",
            )
            for name, colour in (("true", (30, 30, 30)), ("felt", (213, 94, 0)))
        }
        look(server, *self._master.view, near=0.01, phone=2.3)

    def _touched(self) -> list[tuple[int, Any]]:
        """Boxes of the scene, with their geoms."""
        plant, found = self._setup.slave.plant, []
        for geom in range(plant.model.ngeom):
            name = plant.model.body(plant.model.geom_bodyid[geom]).name
            if plant.model.geom_type[geom] != _box_type() or name.startswith("arm:"):
                continue
            r, g, b = (round(255 * float(c)) for c in plant.model.geom_rgba[geom][:3])
            size = 2.0 * np.array(plant.model.geom_size[geom])
            found.append(
                (geom, self._server.scene.add_box(f"/scene/{geom}", dimensions=size, color=(r, g, b)))
            )
        return found

    def _build_controls(self) -> None:
        gui = self._server.gui
        self._words = gui.add_html("")
        self._said = ""
        with gui.add_folder("Network, each way"):
            now = self.faults
            fields = {
                name: gui.add_slider(text, 0.0, max(most, value), step, value)
                for name, text, most, step, value in (
                    ("delay", "delay [ms]", 500.0, 5.0, 1e3 * now.delay),
                    ("jitter", "jitter [ms]", 100.0, 5.0, 1e3 * now.jitter),
                    ("loss", "loss [%]", 50.0, 1.0, 100.0 * now.loss),
                )
            }

            def changed(_: Any) -> None:
                self.faults = replace(
                    self.faults,
                    delay=1e-3 * fields["delay"].value,
                    jitter=1e-3 * fields["jitter"].value,
                    loss=1e-2 * fields["loss"].value,
                )

            for handle in fields.values():
                handle.on_update(changed)
            cut = gui.add_button("Cut the link", color="red")

            def cut_it(_: Any) -> None:
                self.cut = not self.cut
                cut.label = "Restore the link" if self.cut else "Cut the link"

            cut.on_click(cut_it)
        with gui.add_folder("Hand"):
            clutch = gui.add_checkbox("clutch closed", True)

            def clutched(_: Any) -> None:
                self.closed = clutch.value

            clutch.on_update(clutched)
            if self._person is not None:
                self._build_hand(self._person)
            elif isinstance(self._setup.device, RateMaster):
                source = self._setup.device.source
                gui.add_html(
                    f'{_STYLE}<div class="pp"><div class="line"><b>{escape(source.name)}</b>: '
                    f"{escape(source.usage)}</div></div>"
                )
        with gui.add_folder(self._master.what):
            scale = self._setup.follower.force_scale
            keys = (
                ("true", _TRUE),
                ("estimated", _ESTIMATED),
                ("felt" if scale == 1.0 else f"felt / {scale:g}", _FELT),
            )
            self._forces = self._plot(keys, f"size [{self._master.unit}]")
            self._joints = gui.add_html("") if isinstance(self._master, _Leader) else None
        with gui.add_folder("Energy in the tanks"):
            self._tanks = self._plot((("master", LIGHT["blue"]), ("slave", LIGHT["orange"])), "[J]")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)

    def _build_hand(self, person: Person) -> None:
        gui = self._server.gui
        own = gui.add_checkbox("moved by these, not by the script", False)
        if isinstance(self._master, _Leader):
            names = [f"{joint.name} [deg]" for joint in self._setup.slave.model.joints]
            most, unit = _TURN_DEG, math.radians(1.0)
        else:
            names, most, unit = [f"{name} [mm]" for name in "xyz"], 150.0, 1e-3
        axes = [gui.add_slider(name, -most, most, 1.0, 0.0) for name in names]

        def moved(_: Any) -> None:
            person.go(unit * np.array([a.value for a in axes]) if own.value else None)

        own.on_update(moved)
        for axis in axes:
            axis.on_update(moved)

    def _plot(self, keys: tuple[tuple[str, str], ...], unit: str) -> Any:
        import viser.uplot as uplot

        legend = "".join(
            f'<span class="key"><i style="background:{colour}"></i>{name}</span>' for name, colour in keys
        )
        gui = self._server.gui
        gui.add_html(f'{_STYLE}<div class="pp"><div class="line">{legend} {unit}</div></div>')
        nothing = np.array([0.0, 1.0])
        return gui.add_uplot(
            data=(nothing,) * (1 + len(keys)),
            series=(
                uplot.Series(label="time [s]"),
                *(uplot.Series(label=name, stroke=colour, width=1.4) for name, colour in keys),
            ),
            scales={"x": uplot.Scale(time=False)},
            axes=PLOT_AXES,
            legend=uplot.Legend(show=False),
            height=118,
            padding=(6, 8, 0, 0),
        )

    # --- while it runs -------------------------------------------------------------------------------------------

    def tap(self, k: int, run: Run) -> Wish:
        """To be called at the end of every period `k`: it keeps real time, and tells what the page wants."""
        self._run = run, k
        self._pace.wait(k)
        return Wish(self.faults, self.cut, self.closed)

    def _show(self) -> None:
        while not self._over.wait(1.0 / FPS):
            self.update()

    def update(self) -> None:
        """Bring the page up to date."""
        if self._run is None:
            return
        run, k = self._run
        slave, scale = self._setup.slave, self._setup.follower.force_scale
        with self._server.atomic():
            _place(self._frames, slave.model, run.q[k], np.zeros(3))
            self._goal.position, true, felt = self._master.move(run, k)
            for geom, box in self._boxes:
                data = slave.plant.data
                box.position = np.array(data.geom_xpos[geom])
                box.wxyz = _wxyz(np.array(data.geom_xmat[geom]).reshape(3, 3))
            self._arrows["true"].points, self._arrows["felt"].points = _line(*true), _line(*felt)
            if self.frames % 3 == 0:
                self._curves(run, k, scale)
                self._say(run, k)
        self.frames += 1

    def _curves(self, run: Run, k: int, scale: float) -> None:
        rows = np.arange(max(0, k + 1 - round(_SPAN_S / PERIOD)), k + 1)
        rows = rows[:: max(1, len(rows) // _POINTS)]
        if len(rows) < 2:
            return
        t = run.time[rows]
        sizes = [np.linalg.norm(x[rows], axis=1) for x in (run.true, run.estimated, run.felt / scale)]
        self._forces.data = (t, *sizes)
        self._tanks.data = (t, *(np.ascontiguousarray(run.levels[rows, i]) for i in range(2)))

    def _say(self, run: Run, k: int) -> None:
        events = Event(int(run.master_events[k] | run.slave_events[k]))
        reasons = [text for at, text in run.reasons[-1:] if run.holding]
        others = event_words(events & ~(Event.LINK | Event.WORKSPACE)) if reasons else event_words(events)
        words = "; ".join(filter(None, [*reasons, others]))
        device = self._setup.device
        todo = device.status if isinstance(device, RateMaster) and not reasons else ""
        held = bool(events & (Event.LINK | Event.INPUT | Event.CLUTCH))
        tone = "#c43b1d" if held else "#b07a00" if reasons or events else "#007a4d"
        f, true, felt = self.faults, np.linalg.norm(run.true[k]), np.linalg.norm(run.felt[k])
        what, unit = self._master.what.split()[0].lower(), self._master.unit
        digits = 1 if unit == "N" else 2
        lines = [
            f'{_STYLE}<div class="pp"><span class="badge" style="background:{tone}">'
            f"{'held' if held else 'limited' if reasons or events else 'coupled'}</span>",
            f'<div class="line">{escape(words)}</div>' if words else "",
            f'<div class="line"><b>{escape(todo)}</b></div>' if todo else "",
            f'<div class="line">time <b>{run.time[k]:.0f} s</b>, {what} true <b>{true:.{digits}f} {unit}</b>, '
            f"felt <b>{felt:.{digits}f} {unit}</b></div>",
            *self._turned(run, k),
            f'<div class="line">delay {1e3 * f.delay:.0f} ms, jitter {1e3 * f.jitter:.0f} ms, '
            f"loss {100.0 * f.loss:.0f} %{', cut' if self.cut else ''}</div></div>",
        ]
        text = "".join(lines)
        if text != self._said:
            self._words.content = self._said = text
        if self._joints is not None:
            self._joints.content = self._joint_rows(run, k)

    def _joint_rows(self, run: Run, k: int) -> str:
        """Each joint's torque, true and felt."""
        rows = ""
        for joint, *torques in zip(self._setup.slave.model.joints, run.true[k], run.felt[k], strict=True):
            cells = "".join(f"<td>{round(t, 2) + 0.0:+.2f}</td>" for t in torques)  # no -0.00
            rows += f"<tr><td>{escape(joint.name)}</td>{cells}</tr>"
        head = "<tr><th></th><th>true</th><th>felt</th></tr>"
        return f'{_STYLE}<div class="pp"><table class="nums">{head}{rows}</table></div>'

    def _turned(self, run: Run, k: int) -> list[str]:
        """A line on the orientation, if it is coupled."""
        if not self._setup.slave.pose:
            return []
        away = np.linalg.norm(turn_between(run.wanted_turn[k], run.tip_turn[k]))
        true, felt = np.linalg.norm(run.true_torque[k]), np.linalg.norm(run.felt_torque[k])
        return [
            f'<div class="line">turned away by <b>{1e3 * away:.1f} mrad</b>, torque true <b>{true:.2f} N m</b>, '
            f"felt <b>{felt:.2f} N m</b></div>"
        ]

    def close(self) -> None:
        """End the page."""
        self._over.set()
        self._thread.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def _box_type() -> int:
    from ..simulate._model import mujoco

    return int(mujoco().mjtGeom.mjGEOM_BOX)


def _line(tail: Array, force: Array) -> npt.NDArray[np.float32]:
    return np.array([[tail, tail + _NEWTONS * force]], dtype=np.float32)
