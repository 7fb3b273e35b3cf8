"""The page in the browser: viser shows what :mod:`palpate.view.scene` says of a source."""

from __future__ import annotations

import contextlib
import io
import math
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arm import Arm, Array
from ..errors import InputError, MissingExtraError, PalpateError
from ..pipeline import ESTIMATORS, OBSERVERS
from ..report._style import LIGHT
from ..report._text import escape, number
from ._guard import guarded
from .scene import (
    Badge,
    Channels,
    Force,
    ForceView,
    Reading,
    Scale,
    ShownArm,
    Weight,
    contact_badge,
    link_frames,
    lit_links,
    mass_range,
)
from .source import Holds, Image, Moves, Plays, Powers, Pushable, Records, Source, Tunes

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer

FPS = 32.0
"""updates of the page per second [Hz]"""
HOST, PORT = "127.0.0.1", 8080
_WORDS_EVERY = 4
"""frames between two changes of numbers: a person reads no faster"""
_JOINT_COLOURS = [LIGHT[name] for name in ("blue", "red", "green", "pink", "orange", "sky", "yellow", "grey")]
_FORCE_COLOUR, _LIT, _PERHAPS, _OBJECT = (213, 94, 0), (255, 120, 0), (255, 190, 110), (230, 159, 0)
_SMOOTH_S = 0.15
"""the arrow is smoothed over so long [s]: it shows what pushes, not how noisy encoders are"""
_DENSITY = 2000.0
"""of the cube that stands for what is held [kg/m^3]"""
_PHONE = 0.62
"""a picture narrower than this part of its height is a phone's"""
_AXES = ("x", "y", "z")
_SPEEDS = ("0.25", "0.5", "1", "2", "5", "20")

PLOT_AXES: Any = tuple({"size": size, "ticks": {"size": 4}, "font": "11px system-ui"} for size in (22, 46))
"""time below and values beside a small plot"""

_STYLE = """<style>
.pp{font-family:system-ui,sans-serif;line-height:1.35;padding:.35em .75em 0;color:#1b2430}
.pp .mass{font-size:2.35em;font-weight:650;letter-spacing:-.02em;white-space:nowrap;font-variant-numeric:tabular-nums}
.pp .mass small{font-size:.5em;font-weight:450;color:#5d6875;letter-spacing:0}
.pp .dim{color:#98a2ad}
.pp .badge{display:inline-block;padding:.1em .65em;border-radius:1em;font-size:.85em;font-weight:600;color:#fff}
.pp .line{font-size:.85em;color:#5d6875;margin:.2em 0}
.pp .line b{color:#1b2430;font-weight:600;font-variant-numeric:tabular-nums}
.pp .key{white-space:nowrap;margin-right:.7em}
.pp .key i{display:inline-block;width:.8em;height:.25em;border-radius:.1em;margin-right:.3em;vertical-align:middle}
@media (max-width:36em){
div[style*="width: 20em"]{width:100%!important}
div[style*="max-height: 60%"]{max-height:54%!important}
}
.pp .nums{width:100%;font-size:.85em;color:#1b2430;border-collapse:collapse;font-variant-numeric:tabular-nums}
.pp .nums th{font-weight:450;color:#5d6875}
.pp .nums th,.pp .nums td{text-align:right;padding:.1em 0}
.pp .nums td:first-child{text-align:left}
.pp .cap{font-size:.8em;font-weight:600;margin:.15em 0 0}
</style>"""


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise MissingExtraError("view", "the live page") from None
    return viser


def check_address(host: str, port: int) -> None:
    """Whether a page can be served there.

    Raises:
        InputError: no such address here, or somebody else listens there.
    """
    try:
        with contextlib.closing(socket.create_server((host, port))):
            pass
    except OverflowError:
        raise InputError(f"port must be 0 to 65535, got {port}") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"no page can be served at {host}:{port} ({reason}): another program, maybe another palpate view, listens "
            "there. End it, or choose another port with --listen, e.g. --listen 8081 (0 takes any free one)"
        ) from None


def look(server: ViserServer, eye: Array, middle: Array, near: float, phone: float = 1.7) -> None:
    """How a browser looks at the scene at first. On a phone the controls cover the lower half: the scene is seen from
    farther away, in the upper one.

    Args:
        server: of the page.
        eye: (3,) from where [m].
        middle: (3,) at what [m].
        near: what is nearer is not drawn [m].
        phone: how many times as far a phone is.
    """
    first = server.initial_camera
    first.position, first.look_at = _xyz(eye), _xyz(middle)
    first.fov, first.near = 0.75, near

    def welcome(client: ClientHandle) -> None:
        done = False

        def place(camera: CameraHandle) -> None:
            nonlocal done
            # the browser takes the first view only after it has said hello
            if done or not np.allclose(camera.position, eye, atol=1e-3):
                return
            done = True
            if not 0.0 < camera.aspect < _PHONE:
                return
            away = (eye - middle) * phone
            half_height = float(np.linalg.norm(away)) * math.tan(0.5 * camera.fov)
            down = np.array([0.0, 0.0, 0.56 * half_height])
            camera.position = middle + away - down
            camera.look_at = middle - down

        client.camera.on_update(place)

    server.on_client_connect(welcome)


def _xyz(place: Array) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in place)
    return x, y, z


class Page:
    """A live page of a source. Create it, then :meth:`run` it, or call :meth:`update` for every frame.

    Args:
        source: started by whoever made it.
        host: address to listen at; everybody who reaches it can move the arm.
        port: 0: any free one.
        title: of the page.
        meshes: draw meshes of the arm's description instead of primitives, where their files are found.

    Raises:
        InputError: the address is taken.
        MissingExtraError: viser is not installed.
    """

    def __init__(
        self,
        source: Source,
        *,
        host: str = HOST,
        port: int = PORT,
        title: str = "palpate",
        meshes: bool = False,
    ) -> None:
        viser = _viser()
        check_address(host, port)
        with contextlib.redirect_stdout(io.StringIO()), guarded(host):  # it greets with a table of its own
            self._server: ViserServer = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        if port not in (0, self._server.get_port()):
            self._server.stop()
            raise InputError(
                f"port {port} was taken by another program just now: try again, or take another --listen"
            )
        # nobody on the network may publish a robot's page through viser's relay
        vars(self._server)["request_share_url"] = _no_share
        self._source = source
        self.url = f"http://{'[' + host + ']' if ':' in host else host}:{self._server.get_port()}"
        self.frames = 0
        """updates made so far"""
        self._arms = [_ArmNodes(self._server, i, shown, meshes) for i, shown in enumerate(source.arms)]
        self._images: dict[str, tuple[Any, Image]] = {}
        self._camera_folder: Any = None
        self._dress()
        self._build()

    # --- building ------------------------------------------------------------------------------------------------

    def _dress(self) -> None:
        server = self._server
        server.gui.configure_theme(
            dark_mode=False,
            show_logo=False,
            show_share_button=False,
            control_width="medium",
            brand_color=(0, 114, 178),
        )
        # shadows make browsers without a graphics card wait for seconds
        server.scene.configure_default_lights(enabled=True, cast_shadow=False)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for nodes in self._arms:
            for q in (np.zeros(nodes.shown.arm.n), *nodes.shown.poses.values()):
                points = (nodes.shown.placement @ link_frames(nodes.shown.arm, q))[:, :3, 3]
                low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        reach = max(nodes.shown.arm.reach for nodes in self._arms)
        floor = 0.0 if low[2] > -0.05 * reach else float(low[2]) - 0.15 * reach
        cell = 10.0 ** math.floor(math.log10(reach))
        cell = cell if reach / cell > 4.0 else 0.5 * cell
        server.scene.add_grid(
            "/floor",
            width=20.0 * cell,
            height=20.0 * cell,
            cell_size=0.5 * cell,
            section_size=cell,
            position=(0.0, 0.0, floor),
            cell_color=(236, 239, 243),
            section_color=(222, 226, 232),
            shadow_opacity=0.2,
        )
        middle = 0.5 * (low + high)
        away = 1.35 * (reach + float(np.linalg.norm(high - low)))
        look(server, middle + away * np.array([0.72, -0.58, 0.38]), middle, 0.01 * reach)

    def _build(self) -> None:
        gui, source = self._server.gui, self._source
        self._words = gui.add_html(_STYLE)
        self._said = ""
        names = [nodes.shown.name for nodes in self._arms]
        self._chosen = gui.add_dropdown("arm", names) if len(names) > 1 else None
        if isinstance(source, Plays):
            self._build_playback(source)
        if isinstance(source, Powers):
            self._build_drives(source)
        if isinstance(source, Moves):
            self._build_motion(source)
        if isinstance(source, Holds):
            self._build_object(source)
        if isinstance(source, Pushable):
            self._build_push(source)
        self._build_scale(source)
        if isinstance(source, Tunes):
            self._build_tuning(source)
        self._build_curves()
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)

    @property
    def _arm(self) -> int:
        """The arm that the controls are for."""
        if self._chosen is None:
            return 0
        return [nodes.shown.name for nodes in self._arms].index(self._chosen.value)

    def _on(self, handle: Any, act: Callable[[Any], None]) -> None:
        """Let a person's click or change do something; what goes wrong is told to everybody who looks."""

        def called(event: Any) -> None:
            if event.client is None:  # changed by this program, not by a person
                return
            try:
                act(event)
            except PalpateError as error:
                self.tell(str(error), error=True)

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(called)

    def tell(self, text: str, *, error: bool = False) -> None:
        """Show a message for some seconds."""
        for client in self._server.get_clients().values():
            client.add_notification(
                "Not done" if error else "Note",
                escape(text),
                color="red" if error else "blue",
                auto_close_seconds=12.0 if error else 8.0,
            )

    def _build_playback(self, source: Plays) -> None:
        gui = self._server.gui
        with gui.add_folder("Recording"):
            end = max(source.duration, 1e-3)
            self._slider: Any = gui.add_slider("time [s]", 0.0, end, min(0.01, end), 0.0)
            self._dragged = -math.inf
            button = gui.add_button("Pause", color="blue")
            self._play_button = button
            speed = gui.add_button_group("speed", _SPEEDS)

        def seek(_: Any) -> None:
            self._dragged = time.monotonic()
            source.seek(float(self._slider.value))

        self._on(self._slider, seek)
        self._on(button, lambda _: source.play(not source.playing))
        self._on(speed, lambda _: source.pace(float(speed.value)))

    def _build_drives(self, source: Powers) -> None:
        gui = self._server.gui
        with gui.add_folder("Drives"):
            on = gui.add_button("Switch on: the arm holds itself", color="blue")
            off = gui.add_button("Switch off: hold it first!", color="red")
        self._on(on, lambda _: source.power(True))
        self._on(off, lambda _: source.power(False))

    def _build_motion(self, source: Moves) -> None:
        gui = self._server.gui
        shown = self._arms[0].shown
        with gui.add_folder("Move"):
            poses = gui.add_button_group("pose", list(shown.poses))
            goal: Any = gui.add_text("angles [rad]", ", ".join("0" for _ in range(shown.arm.n)))
            go = gui.add_button("Go to these angles", color="blue")
            halt = gui.add_button("Stop here", color="red")

        def to_pose(_: Any) -> None:
            name = str(poses.value)
            known = self._arms[self._arm].shown.poses
            if name in known:
                goal.value = ", ".join(f"{angle:g}" for angle in known[name])
            source.go(self._arm, name)

        self._on(poses, to_pose)
        self._on(go, lambda _: source.go(self._arm, str(goal.value)))
        self._on(halt, lambda _: source.halt(self._arm))

    def _build_object(self, source: Holds) -> None:
        gui = self._server.gui
        usual = self._arms[0].shown.usual_mass
        most = max(3.0 * usual, source.held(0))
        step = 10.0 ** math.floor(math.log10(0.02 * usual))
        with gui.add_folder("Object (simulated)"):
            mass = gui.add_slider("mass [kg]", 0.0, most, step, source.held(0), hint="0: the hand is empty")
        self._on(mass, lambda _: source.hold(self._arm, float(mass.value)))

    def _build_push(self, source: Pushable) -> None:
        gui = self._server.gui
        shown = self._arms[0].shown
        most = float(f"{6.0 * 9.81 * shown.usual_mass:.1g}")
        links = [j.link for j in shown.arm.joints]
        with gui.add_folder("Push (simulated)", expand_by_default=False):
            link = gui.add_dropdown("link", links, initial_value=links[-1])
            axis = gui.add_dropdown("along", [s + a for a in _AXES for s in ("+", "−")], initial_value="+y")
            force: Any = gui.add_slider("force [N]", 0.0, most, most / 100.0, 0.0)
            end = gui.add_button("Let go", color="gray")

        def push(_: Any) -> None:
            name = str(axis.value)
            F = np.zeros(3)
            F[_AXES.index(name[1])] = float(force.value) * (1.0 if name[0] == "+" else -1.0)
            source.push(self._arm, str(link.value), F)

        def let_go(event: Any) -> None:
            force.value = 0.0
            push(event)

        for handle in (link, axis, force):
            self._on(handle, push)
        self._on(end, let_go)

    def _build_scale(self, source: Source) -> None:
        gui = self._server.gui
        with gui.add_folder("Scale and recording" if isinstance(source, Records) else "Scale"):
            tare = gui.add_button("Tare", color="blue", hint="What is held now counts as nothing")
            clear = gui.add_button("Undo tare", color="gray", visible=False)
            self._clear = clear
            if isinstance(source, Records):
                self._record_button = gui.add_button("Record", color="teal")
                self._on(self._record_button, lambda _: self._toggle_recording(source))

        def do_tare(_: Any) -> None:
            why = self._arms[self._arm].scale.tare(self._source.reading(self._arm))
            if why:
                raise InputError(why)

        self._on(tare, do_tare)
        self._on(clear, lambda _: self._arms[self._arm].scale.clear())

    def _toggle_recording(self, source: Records) -> None:
        if source.recording is None:
            self.tell(
                f"Recording to {source.record()}; the estimate starts anew, so that it replays bit for bit."
            )
        else:
            self.tell(f"Recorded: {source.end_recording()}")

    def _build_tuning(self, source: Tunes) -> None:
        gui = self._server.gui
        options = source.options(0)
        observer, payload = options.get("observer") or {}, options.get("payload") or {}
        with gui.add_folder("Estimators", expand_by_default=False):
            which = gui.add_dropdown("observer", list(OBSERVERS), initial_value=observer.get("name"))
            how = gui.add_dropdown("mass by", list(ESTIMATORS), initial_value=payload.get("name"))
            self._fields: dict[str, dict[str, Any]] = {"observer": {}, "payload": {}}
            folders = {
                "observer": gui.add_folder("Observer", expand_by_default=True),
                "payload": gui.add_folder("Mass", expand_by_default=True),
            }
            use = gui.add_button("Use these", color="blue")

        def show(part: str, values: dict[str, Any]) -> None:
            for field in self._fields[part].values():
                field.remove()
            with folders[part]:
                self._fields[part] = dict(_option_fields(gui, values))

        def chosen(part: str, name: str) -> None:
            kinds = OBSERVERS if part == "observer" else ESTIMATORS
            now = source.options(self._arm).get(part) or {}
            show(part, now if now.get("name") == name else {"name": name, **kinds[name]().options()})

        def apply(_: Any) -> None:
            new = dict(source.options(self._arm))
            for part, name in (("observer", which.value), ("payload", how.value)):
                new[part] = {"name": name, **{k: f.value for k, f in self._fields[part].items()}}
            source.tune(self._arm, new)
            self.tell("The estimate starts anew with these parameters.")

        show("observer", observer)
        show("payload", payload)
        self._on(which, lambda _: chosen("observer", str(which.value)))
        self._on(how, lambda _: chosen("payload", str(how.value)))
        self._on(use, apply)

    def _build_curves(self) -> None:
        gui = self._server.gui
        panel = gui.add_panel()
        spans = {_span_words(s): s for s in self._source.spans}
        with panel.add_tab("Curves"):
            self._span = gui.add_dropdown("the last", list(spans))
            self._spans = spans
            legend = gui.add_html("")
            self._plots = _Plots(gui, self._arms[0].shown.arm, legend)
        panel.dock_left()
        panel.set_width(340)
        self._next_plot = 0

    # --- every frame ---------------------------------------------------------------------------------------------

    def run(self, stop: Callable[[], bool], fps: float = FPS) -> None:
        """Update the page until `stop()`."""
        due = time.monotonic()
        while not stop():
            self.update()
            due += 1.0 / fps
            rest = due - time.monotonic()
            if rest > 0.0:
                time.sleep(rest)
            elif rest < -0.5:
                due -= rest  # what is that late is left out

    def update(self) -> None:
        """Bring the page up to date with the source."""
        for text in self._source.messages():
            self.tell(text)
        readings = [self._source.reading(i) for i in range(len(self._arms))]
        with self._server.atomic():
            for nodes, reading in zip(self._arms, readings, strict=True):
                if reading is not None:
                    nodes.update(reading)
            if self.frames % _WORDS_EVERY == 0:
                self._say(readings)
            arm = self._arm
            time_s, rows = self._source.curves(arm, self._spans[str(self._span.value)])
            self._plots.update(self._next_plot, self._arms[arm].shown.arm, time_s, rows)
            self._next_plot = (self._next_plot + 1) % self._plots.count
            self._show_images()
        self.frames += 1

    def _say(self, readings: list[Reading | None]) -> None:
        source = self._source
        parts = [_STYLE, '<div class="pp">', _badge(source.state)]
        for nodes, reading in zip(self._arms, readings, strict=True):
            parts.append(_arm_words(nodes, reading, several=len(self._arms) > 1))
        if isinstance(source, Records) and source.recording is not None:
            parts.append(f'<div class="line">● recording <b>{escape(source.recording.name)}</b></div>')
        parts.append("</div>")
        text = "".join(parts)
        if text != self._said:
            self._words.content = self._said = text
        self._clear.visible = self._arms[self._arm].scale.tared
        if isinstance(source, Records):
            label = "Record" if source.recording is None else "Stop recording"
            if self._record_button.label != label:
                self._record_button.label = label
                self._record_button.color = "teal" if source.recording is None else "red"
        if isinstance(source, Plays):
            label = "Pause" if source.playing else "Play"
            if self._play_button.label != label:
                self._play_button.label = label
            if time.monotonic() - self._dragged > 0.5:
                self._slider.value = round(min(source.position, self._slider.max), 2)

    def _show_images(self) -> None:
        for name, picture in self._source.images().items():
            known = self._images.get(name)
            if known is None:
                if self._camera_folder is None:
                    self._camera_folder = self._server.gui.add_folder("Cameras")
                with self._camera_folder:
                    handle = self._server.gui.add_image(picture, label=name, format="jpeg")
                self._images[name] = (handle, picture)
            elif known[1] is not picture:
                known[0].image = picture
                self._images[name] = (known[0], picture)

    def close(self) -> None:
        """End the page; browsers say that the connection is lost, and return when it is there again."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()


def _no_share(verbose: bool = True) -> None:
    """Instead of viser's own, which opens a tunnel into the internet."""


def _span_words(span: float) -> str:
    if math.isinf(span):
        return "all"
    return f"{span:g} s" if span < 60.0 else f"{span / 60.0:g} min"


def _badge(badge: Badge) -> str:
    return (
        f'<span class="badge" style="background:{LIGHT[badge.tone]}" title="{escape(badge.detail)}">'
        f"{escape(badge.text)}</span>"
    )


def _arm_words(nodes: _ArmNodes, reading: Reading | None, *, several: bool) -> str:
    name = f'<div class="line"><b>{escape(nodes.shown.name)}</b></div>' if several else ""
    if reading is None:
        return f'{name}<div class="mass dim">–</div>'
    weight = nodes.weight(reading)
    dim = "" if weight.badge.tone == "green" else " dim"
    contact = contact_badge(nodes.shown, reading)
    push = nodes.force.text if nodes.force is not None else "none felt"
    lines = [
        f'{name}<div class="mass{dim}" title="95 % interval">{weight.value}<small> ± {weight.half} </small>'
        f"<small>{weight.unit}</small></div>",
        f"{_badge(weight.badge)} {_badge(contact)}",
        f'<div class="line">{escape(weight.badge.detail)}</div>',
        f'<div class="line">push at the hand: <b>{escape(push)}</b></div>',
    ]
    if weight.tared:
        lines.append(f'<div class="line">tared by <b>{escape(weight.tared)}</b></div>')
    if not math.isnan(reading.true_mass):
        lines.append(f'<div class="line">really held: <b>{number(1e3 * reading.true_mass)} g</b></div>')
    return "".join(lines)


def _option_fields(gui: Any, values: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """A field for every option that is a number, a choice of true and false, or a word."""
    for name, value in values.items():
        if name == "name" or value is None:
            continue
        label = name.replace("_", " ")
        if isinstance(value, bool):
            yield name, gui.add_checkbox(label, value)
        elif isinstance(value, int | float):
            # the browser steps by it; any number may be typed
            step = 10.0 ** (math.floor(math.log10(abs(value))) - 1) if value else 0.01
            whole = isinstance(value, int)
            yield name, gui.add_number(label, value, step=max(1, int(step)) if whole else step)


class _Plots:
    """Mass and the joints' curves; one is renewed per frame."""

    _CAPTIONS = ("Mass [{mass}], with 95 % interval", "Position [rad]", "Speed [rad/s]", "Motor torque [N m]",
                 "External torque [N m]")  # fmt: skip

    def __init__(self, gui: Any, arm: Arm, legend: Any) -> None:
        import viser.uplot as uplot

        self._legend, self._named = legend, ""
        self._captions: list[Any] = []
        self._plots: list[Any] = []
        nothing = np.array([0.0, 1.0])
        for i, caption in enumerate(self._CAPTIONS):
            self._captions.append(gui.add_html(f'<div class="pp"><div class="cap">{caption}</div></div>'))
            if i == 0:
                series = [
                    uplot.Series(label="time [s]"),
                    uplot.Series(label="upper", stroke=LIGHT["sky"], width=0.5),
                    uplot.Series(label="lower", stroke=LIGHT["sky"], width=0.5),
                    uplot.Series(label="not to be used", stroke=LIGHT["grey"], width=1.0),
                    # these may be NaN: kept out of the range, and the good one in dots, which leave gaps where it is
                    uplot.Series(label="true", stroke=LIGHT["ink"], width=1.0, dash=(4.0, 4.0), auto=False),
                    uplot.Series(
                        label="good",
                        stroke=LIGHT["blue"],
                        width=0.0,
                        auto=False,
                        points=uplot.Series_Points(show=True, size=3.0, fill=LIGHT["blue"], width=0.0),
                    ),
                ]
                bands: Any = (uplot.Band(series=(1, 2), fill="rgba(86,180,233,0.22)"),)
            else:
                series = [uplot.Series(label="time [s]")] + [
                    uplot.Series(label=joint.name, stroke=_JOINT_COLOURS[j % len(_JOINT_COLOURS)], width=1.4)
                    for j, joint in enumerate(arm.joints)
                ]
                bands = None
            self._plots.append(
                gui.add_uplot(
                    data=tuple(nothing for _ in series),
                    series=tuple(series),
                    bands=bands,
                    scales={"x": uplot.Scale(time=False)},
                    axes=PLOT_AXES,
                    legend=uplot.Legend(show=False),
                    height=118,
                    padding=(6, 8, 0, 0),
                )
            )

    @property
    def count(self) -> int:
        """How many."""
        return len(self._plots)

    def update(self, which: int, arm: Arm, time_s: Array, rows: Array) -> None:
        """Renew one."""
        if which == 0:
            keys = "".join(
                f'<span class="key"><i style="background:{_JOINT_COLOURS[j % len(_JOINT_COLOURS)]}"></i>'
                f"{escape(joint.name, 24)}</span>"
                for j, joint in enumerate(arm.joints)
            )
            if keys != self._named:
                self._legend.content = f'{_STYLE}<div class="pp"><div class="line">{keys}</div></div>'
                self._named = keys
        if len(time_s) < 2:
            return
        channels = Channels(arm.n)
        plot = self._plots[which]
        if which:
            values = channels.joints(rows, which - 1)
        else:
            mass, low, high, good, true = channels.mass(rows).T
            bottom, top = mass_range(mass, low, high, good, true)
            factor = 1.0 if max(abs(bottom), abs(top)) >= 1.0 else 1e3
            self._caption("kg" if factor == 1.0 else "g")
            values = factor * np.column_stack((high, low, mass, true, good)).clip(bottom, top)
        columns = len(plot.data) - 1
        plot.data = (time_s, *(np.ascontiguousarray(values[:, k]) for k in range(columns)))

    def _caption(self, unit: str) -> None:
        text = f'<div class="pp"><div class="cap">{self._CAPTIONS[0].format(mass=unit)}</div></div>'
        if self._captions[0].content != text:
            self._captions[0].content = text


class _ArmNodes:
    """An arm in the 3-D scene, with its arrow, its object and its labels."""

    def __init__(self, server: ViserServer, index: int, shown: ShownArm, meshes: bool) -> None:
        self.shown, self.scale = shown, Scale()
        self._force_view = ForceView()
        self.force: Force | None = None
        self._smooth: tuple[float, Array] | None = None
        self._scene = server.scene
        root = f"/arm{index}"
        reach = shown.arm.reach
        R = shown.placement
        self._scene.add_frame(root, show_axes=False, wxyz=_wxyz(R[:3, :3]), position=R[:3, 3])
        # each link within the one before: a motion is one message per joint
        places = [root]
        self._frames = []
        for joint in shown.arm.joints:
            places.append(f"{places[-1]}/{len(places)}")
            T = joint.T_parent_joint
            self._frames.append(
                self._scene.add_frame(places[-1], show_axes=False, wxyz=_wxyz(T[:3, :3]), position=T[:3, 3])
            )
        self._fixed = [_wxyz(joint.T_parent_joint[:3, :3]).tolist() for joint in shown.arm.joints]
        self._shapes: list[list[tuple[Any, tuple[int, int, int]]]] = [[] for _ in places]
        for link, handle, colour in _drawn(self._scene, places, shown.arm, meshes):
            self._shapes[link + 1].append((handle, colour))
        self._lit = (-1, -1)
        self._q = np.full(shown.arm.n, np.nan)
        thick = 0.012 * reach
        self._head_length = 5.0 * thick
        self._arrow = self._scene.add_frame(f"{root}_force", show_axes=False, visible=False)
        self._shaft = self._scene.add_cylinder(
            f"{root}_force/shaft",
            radius=thick,
            height=1.0,
            color=_FORCE_COLOUR,
            cast_shadow=False,
            scale=(1.0, 1.0, thick),
        )
        vertices, faces = _cone(24)
        self._head = self._scene.add_mesh_simple(
            f"{root}_force/head",
            vertices[:, :] * [1.0, 1.0, -1.0] + [0.0, 0.0, 1.0],
            faces[:, ::-1],
            color=_FORCE_COLOUR,
            cast_shadow=False,
            scale=(2.4 * thick, 2.4 * thick, self._head_length),
        )
        self._cone = self._scene.add_mesh_simple(
            f"{root}_force/cone",
            vertices,
            faces,
            color=_FORCE_COLOUR,
            opacity=0.28,
            side="double",
            cast_shadow=False,
            scale=thick,
        )
        self._force_label = self._scene.add_label(
            f"{root}_force_label", "", visible=False, anchor="bottom-center", font_screen_scale=1.0
        )
        grasp = np.append(shown.arm.grasp, 1.0)
        at = shown.arm.T_last_tip @ grasp
        self._object = self._scene.add_box(
            f"{places[-1]}/object",
            color=_OBJECT,
            dimensions=(1.0, 1.0, 1.0),
            opacity=0.85,
            position=at[:3],
            wxyz=_wxyz(shown.arm.T_last_tip[:3, :3]),
            visible=False,
        )
        self._side = 0.0
        self._label_offset = 0.12 * reach
        self._label = self._scene.add_label(
            f"{root}_mass", "–", anchor="bottom-center", font_screen_scale=1.25
        )

    def weight(self, reading: Reading) -> Weight:
        """The mass as it is shown."""
        return self.scale.weight(reading, pushed=self.force is not None)

    def update(self, reading: Reading) -> None:
        """Show this reading."""
        q = np.asarray(reading.touch.q)
        if not (np.abs(q - self._q) <= 1e-5).all():
            self._q = q.copy()
            known = np.nan_to_num(q)
            self._bend(known.tolist())
            frames = link_frames(self.shown.arm, known)
            hand = (
                self.shown.placement
                @ frames[-1]
                @ self.shown.arm.T_last_tip
                @ np.append(self.shown.arm.grasp, 1)
            )
            self._label.position = hand[:3] + np.array([0.0, 0.0, self._label_offset])
        self._light(lit_links(reading))
        self._show_force(reading)
        weight = self.weight(reading)
        text = weight.text if weight.badge.tone == "green" else weight.badge.text
        if self._label.text != text:
            self._label.text = text
        self._show_object(float(reading.touch.payload.mass) if weight.badge.tone == "green" else 0.0)

    def _bend(self, q: list[float]) -> None:
        """Turn or shift every joint to its angle."""
        for joint, handle, fixed, angle in zip(
            self.shown.arm.joints, self._frames, self._fixed, q, strict=True
        ):
            if joint.kind == "revolute":
                handle.wxyz = _turned(fixed, joint.axis.tolist(), angle)
            else:
                T = joint.T_parent_joint
                handle.position = T[:3, 3] + T[:3, :3] @ (angle * joint.axis)

    def _light(self, lit: tuple[int, int]) -> None:
        if lit == self._lit:
            return
        self._lit = lit
        for link, shapes in enumerate(self._shapes, start=-1):
            for handle, colour in shapes:
                inside = 0 <= lit[0] <= link <= lit[1]
                handle.color = (_LIT if link == lit[0] else _PERHAPS) if inside else colour

    def _show_force(self, reading: Reading) -> None:
        self.force = force = self._force_view.force(self.shown, self._smoothed(reading))
        self._arrow.visible = self._force_label.visible = force is not None
        if force is None:
            return
        length = float(np.linalg.norm(force.tip - force.tail))
        head = min(self._head_length, 0.6 * length)
        shaft = length - head
        self._arrow.wxyz, self._arrow.position = _wxyz(force.R), force.tail
        self._shaft.scale, self._shaft.position = (1.0, 1.0, shaft), (0.0, 0.0, 0.5 * shaft)
        self._head.position = (0.0, 0.0, shaft)
        self._cone.scale = (*force.half_axes, length)
        self._force_label.position = force.tip
        if self._force_label.text != force.text:
            self._force_label.text = force.text

    def _smoothed(self, reading: Reading) -> Reading:
        """The reading with its force smoothed; what it says of its spread stays."""
        wrench = reading.touch.wrench
        if wrench is None or not np.isfinite(wrench.force).all():
            self._smooth = None
            return reading
        F = np.array(wrench.force)
        if self._smooth is not None:
            past = reading.time - self._smooth[0]
            if 0.0 <= past < 1.0:
                F = self._smooth[1] + (1.0 - math.exp(-past / _SMOOTH_S)) * (F - self._smooth[1])
        self._smooth = (reading.time, F)
        return replace(reading, touch=replace(reading.touch, wrench=replace(wrench, force=F)))

    def _show_object(self, mass: float) -> None:
        side = (mass / _DENSITY) ** (1.0 / 3.0) if mass > 0.02 * self.shown.usual_mass else 0.0
        if abs(side - self._side) > 0.02 * self._side:
            self._side = side
            self._object.visible = side > 0.0
            self._object.scale = side or 1.0


def _drawn(
    scene: Any, places: list[str], arm: Arm, meshes: bool
) -> Iterator[tuple[int, Any, tuple[int, int, int]]]:
    """Link, handle and colour of everything that is drawn of an arm; places: of the base and of every link."""
    seen = set()
    if meshes:
        for k, shape in enumerate(s for s in arm.shapes if s.kind == "mesh"):
            mesh = _mesh(shape.filename or "")
            if mesh is None:
                continue
            seen.add(shape.link)
            colour = _rgb(shape.rgba)
            place = {"wxyz": _wxyz(shape.T[:3, :3]), "position": shape.T[:3, 3], "scale": tuple(shape.size)}
            name = f"{places[shape.link + 1]}/mesh{k}"
            yield shape.link, scene.add_mesh_simple(name, mesh[0], mesh[1], color=colour, **place), colour
    for k, shape in enumerate(arm.solid_shapes()):
        if shape.link in seen:
            continue
        name = f"{places[shape.link + 1]}/shape{k}"
        colour = _rgb(shape.rgba)
        place = {"wxyz": _wxyz(shape.T[:3, :3]), "position": shape.T[:3, 3], "color": colour}
        if shape.kind == "box":
            yield shape.link, scene.add_box(name, dimensions=shape.size, **place), colour
        elif shape.kind == "sphere":
            yield shape.link, scene.add_icosphere(name, radius=shape.size[0], **place), colour
        else:
            radius, length = shape.size
            yield shape.link, scene.add_cylinder(name, radius=radius, height=length, **place), colour
            for end in (-0.5, 0.5) if shape.kind == "capsule" else ():
                place["position"] = shape.T[:3, 3] + end * length * shape.T[:3, 2]
                cap = f"{name}{'ab'[end > 0.0]}"
                yield shape.link, scene.add_icosphere(cap, radius=radius, **place), colour


def _mesh(filename: str) -> tuple[Any, Any] | None:
    """Vertices and faces of a mesh file; None: it is not there or cannot be read."""
    import trimesh

    path = filename.removeprefix("file://")
    try:
        mesh = trimesh.load_mesh(path)
    except (
        OSError,
        ValueError,
        ImportError,
    ):  # not found, or a format that trimesh needs another package for
        return None
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _rgb(rgba: tuple[float, float, float, float]) -> tuple[int, int, int]:
    r, g, b = (round(255.0 * min(max(c, 0.0), 1.0)) for c in rgba[:3])
    return r, g, b


def _wxyz(R: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    import viser.transforms as tf

    return np.asarray(tf.SO3.from_matrix(R).wxyz)


def _turned(wxyz: list[float], axis: list[float], angle: float) -> tuple[float, float, float, float]:
    """The quaternion `wxyz`, then a turn by `angle` [rad] about the unit vector `axis` in its axes."""
    w, x, y, z = wxyz
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    a, b, d = s * axis[0], s * axis[1], s * axis[2]
    return (
        w * c - x * a - y * b - z * d,
        w * a + x * c + y * d - z * b,
        w * b - x * d + y * c + z * a,
        w * d + x * b - y * a + z * c,
    )


def _cone(sides: int) -> tuple[Array, Any]:
    """A cone with its apex in the origin and a base of radius 1 at z = 1, open."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    rim = np.column_stack((np.cos(angle), np.sin(angle), np.ones(sides)))
    following = np.roll(np.arange(sides), -1)
    faces = np.column_stack((np.zeros(sides, dtype=int), following + 1, np.arange(sides) + 1))
    return np.vstack((np.zeros(3), rim)), faces
