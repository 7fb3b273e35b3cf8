"""Gamepad, SpaceMouse and keyboard as masters: laws of the mapping, what kernels and people do to devices.

The devices are those of input_fakes.py, and real ones of the kernel where it lets a program make some (/dev/uinput).
"""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cryptography", reason="palpate[teleop] is not installed")

from palpate._core import turn_between
from palpate.cli import main
from palpate.errors import DriverError, InputError
from palpate.teleop.rate_control import KEYS, Curve, RateMaster, Reading, TerminalKeys

evdev = pytest.importorskip("evdev", reason="palpate[gamepad] is not installed")

from evdev import ecodes  # noqa: E402

from input_fakes import (  # noqa: E402
    Computer,
    Hardware,
    gamepad,
    motion_sensors,
    mouse,
    old_gamepad,
    spacemouse,
)
from palpate.teleop.input_devices import (  # noqa: E402
    KINDS,
    LOOK_AGAIN_S,
    RUMBLE_MS,
    SILENT_CAP_S,
    SILENT_STICK_S,
    InputSource,
    advice,
    connected,
)

H = 1e-3
LONG_S = 240.0
FORWARD, LEFT, UP = np.eye(3)

deflections = st.floats(-1.5, 1.5)
curves = st.builds(Curve, dead=st.floats(0.0, 0.9), expo=st.floats(0.0, 1.0))


# --- the mapping ------------------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(curves, deflections, deflections)
def test_a_curve_is_odd_never_falls_and_is_nothing_at_rest(curve: Curve, u: float, w: float) -> None:
    low, high = curve(np.array(sorted((u, w))))
    assert low <= high and -1.0 <= low and high <= 1.0
    assert curve(np.array([-u]))[0] == -curve(np.array([u]))[0]
    assert not np.any(curve(np.array([0.0, curve.dead, -curve.dead, np.nan, np.inf])))
    assert curve(np.array([1.0]))[0] == pytest.approx(1.0)


@pytest.mark.parametrize("numbers", [(1.0, 0.5), (-0.1, 0.5), (0.1, 1.5), (float("nan"), 0.5)])
def test_a_curve_refuses_what_is_none(numbers: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="dead zone"):
        Curve(*numbers)


class Scripted:
    """A source that says what it is told to."""

    name, usage, curve = "scripted", "", Curve(dead=0.1, expo=0.5)

    def __init__(self) -> None:
        self.says: Reading | None = Reading(np.zeros(6))
        self.felt: list[float] = []

    def read(self) -> Reading:
        if self.says is None:
            raise DriverError("scripted is unplugged")
        return self.says

    def feel(self, part: float) -> None:
        self.felt.append(part)

    def close(self) -> None:
        pass


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.lists(st.one_of(deflections, st.just(float("nan"))), min_size=6, max_size=6), max_size=8),
    st.floats(0.01, 1.0),
    st.floats(0.1, 3.0),
    st.sampled_from([3, 6]),
)
def test_no_deflection_is_faster_than_the_largest_speed(
    script: list[list[float]], speed: float, turning: float, axes: int
) -> None:
    source = Scripted()
    master = RateMaster(source, speed=speed, turning=turning, axes=axes)
    x, v = master.read()
    for deflection in script:
        source.says = Reading(np.array(deflection))
        for _ in range(40):
            before, old = x, v
            master.read()
            master.step(np.zeros(3), H)
            x, v = master.read()
            assert np.linalg.norm(v[:3]) <= speed * (1.0 + 1e-9)
            assert np.linalg.norm(v[3:]) <= turning * (1.0 + 1e-9)
            assert np.linalg.norm(v[:3] - old[:3]) <= 2.0 * speed * H / 0.05
            assert x[:3] == pytest.approx(before[:3] + H * v[:3], abs=1e-12)
            if axes == 6:  # dR = [w dt] R, in base axes
                assert turn_between(x[3:], before[3:]) == pytest.approx(H * v[3:], abs=1e-9)
    source.says = Reading(np.zeros(6))
    for _ in range(1000):
        master.read()
        master.step(np.zeros(3), H)
    assert np.abs(master.read()[1]).max() < 1e-6, "at rest it stands still"


def test_a_source_that_is_held_or_gone_stands_still_and_goes_on_from_there() -> None:
    source = Scripted()
    master = RateMaster(source)
    full = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    source.says = Reading(full)
    for _ in range(500):
        master.read()
        master.step(np.array([17.0, 0.0, 0.0]), H)
    assert master.read()[1] == pytest.approx([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-4)
    assert source.felt[-1] == 1.0
    source.says = None
    with pytest.raises(DriverError, match="unplugged"):
        master.read()
    source.says = Reading(full, "let go of it once")
    x, v = master.read()
    assert not np.any(v) and master.status == "let go of it once"
    for _ in range(100):
        master.step(np.zeros(3), H)
        assert np.array_equal(master.read()[0], x)
    for bad in ({"speed": 0.0}, {"smooth": float("nan")}, {"axes": 4}, {"force_limit": -1.0}):
        with pytest.raises(InputError):
            RateMaster(source, **bad)


# --- devices ----------------------------------------------------------------------------------------------------------


class Desk:
    """A computer, its devices and a clock."""

    def __init__(self, folder: Path, *hardware: Hardware) -> None:
        self.computer = Computer(folder, list(hardware))
        self.now = 0.0
        for k, one in enumerate(hardware):
            one.plug(folder / f"event{9 + k}")  # event9 comes before event10

    def source(self, kind: str, path: str | None = None) -> InputSource:
        computer = self.computer
        return InputSource(kind, path, folder=computer.folder, open=computer.open, clock=lambda: self.now)

    def after(self, source: InputSource, seconds: float) -> Reading:
        """What it says after so long."""
        self.now += seconds
        return source.read()


def test_what_is_connected_is_told_apart(tmp_path: Path) -> None:
    desk = Desk(
        tmp_path,
        mouse(),
        gamepad(),
        motion_sensors(),
        spacemouse(relative=True),
        spacemouse(relative=False),
        old_gamepad(),
    )
    (tmp_path / "event2").touch()  # of somebody else
    found = connected(tmp_path, desk.computer.open)
    assert [f.kind for f in found] == [None, None, "gamepad", None, "spacemouse", "spacemouse", "gamepad"]
    assert found[0].problem == "no permission" and found[1].name == "Mouse"
    assert all(not one.handles for one in desk.computer.hardware), "none is kept open"
    assert advice(found) == ""


@pytest.mark.parametrize(
    ("report", "direction"),
    [
        ({ecodes.ABS_Y: -32768}, FORWARD),
        ({ecodes.ABS_X: -32768}, LEFT),
        ({ecodes.ABS_RY: -32768}, UP),
        ({ecodes.ABS_Y: 32767}, -FORWARD),
        ({ecodes.ABS_Z: 255, ecodes.ABS_RZ: 255}, 0.0 * UP),
    ],
)
def test_a_gamepad_moves_while_a_shoulder_button_is_held(
    tmp_path: Path, report: dict[int, int], direction: np.ndarray
) -> None:
    pad = gamepad()
    desk = Desk(tmp_path, pad)
    source = desk.source("gamepad")
    assert desk.after(source, H).held == "hold a shoulder button (LB, RB, L1, R1) to move"
    pad.report(press=ecodes.BTN_TR)
    pad.report(report)
    found = desk.after(source, H)
    assert found.held == "" and found.deflection[:3] == pytest.approx(direction, abs=1e-4)
    pad.report(release=ecodes.BTN_TR)
    assert desk.after(source, H).held
    pad.report(press=ecodes.BTN_SOUTH)
    assert desk.after(source, H).held, "no other button lets it move"


def test_turns_of_a_gamepad_are_right_handed(tmp_path: Path) -> None:
    pad = gamepad()
    desk = Desk(tmp_path, pad)
    source = desk.source("gamepad")
    for code, value, axis, sign in (
        (ecodes.ABS_RX, -32768, 5, 1.0),  # right stick to the left: to the left about up
        (ecodes.ABS_HAT0X, 1, 3, 1.0),  # to the right about forward
        (ecodes.ABS_HAT0Y, -1, 4, 1.0),  # nose down about left
    ):
        pad.report({code: value})
        found = desk.after(source, H).deflection
        assert found[axis] == pytest.approx(sign, abs=1e-4) and np.count_nonzero(np.abs(found) > 0.01) == 1
        pad.report({code: 0})


def test_a_gamepad_of_bytes_has_its_right_stick_elsewhere_and_rests_between_two_numbers(
    tmp_path: Path,
) -> None:
    pad = old_gamepad()
    desk = Desk(tmp_path, pad)
    source = desk.source("gamepad")
    desk.after(source, H)
    pad.report({ecodes.ABS_RZ: 0}, press=ecodes.BTN_TL)
    found = desk.after(source, H)
    assert found.held == "" and found.deflection[2] == 1.0
    assert not np.any(source.curve(np.delete(found.deflection, 2))), "127.5 is the middle, and it says 128"


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize(
    ("code", "axis"),
    [
        (ecodes.ABS_Y, 0),
        (ecodes.ABS_X, 1),
        (ecodes.ABS_Z, 2),
        (ecodes.ABS_RY, 3),
        (ecodes.ABS_RX, 4),
        (ecodes.ABS_RZ, 5),
    ],
)
def test_a_cap_reports_right_backwards_and_down(tmp_path: Path, relative: bool, code: int, axis: int) -> None:
    cap = spacemouse(relative=relative)
    desk = Desk(tmp_path, cap)
    source = desk.source("spacemouse")
    assert not np.any(desk.after(source, H).deflection)
    cap.report({code: -350})
    found = desk.after(source, H)
    assert found.held == "" and found.deflection == pytest.approx(np.eye(6)[axis])


def test_a_cap_that_is_let_go_says_nothing_and_stands_still(tmp_path: Path) -> None:
    cap = spacemouse(relative=True)
    desk = Desk(tmp_path, cap)
    source = desk.source("spacemouse")
    for _ in range(20):
        cap.report({ecodes.REL_X: -200, ecodes.REL_Y: -350})
        cap.report({ecodes.REL_RZ: -350})
        assert desk.after(source, 0.008).deflection == pytest.approx([1.0, 200 / 350, 0.0, 0.0, 0.0, 1.0])
    cap.report({ecodes.REL_X: 0, ecodes.REL_Y: -350})  # the kernel tells no zero, but the packet lacks it
    assert desk.after(source, 0.008).deflection == pytest.approx([1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    cap.report({ecodes.REL_X: 0, ecodes.REL_Y: 0})  # nothing is told of that at all
    cap.report({ecodes.REL_RZ: -350})
    assert desk.after(source, SILENT_CAP_S + H).deflection == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert not np.any(desk.after(source, SILENT_CAP_S + H).deflection)


@settings(deadline=None)
@given(st.integers(-350, 350), st.sampled_from([0, 1, 2, 3, 4, 5]), st.booleans())
def test_a_stuck_cap_or_stick_gives_nothing_after_a_while(
    tmp_path_factory: pytest.TempPathFactory, value: int, code: int, relative: bool
) -> None:
    cap = spacemouse(relative=relative)
    desk = Desk(tmp_path_factory.mktemp("input"), cap)
    source = desk.source("spacemouse")
    desk.after(source, H)
    cap.report({code: value})
    first = desk.after(source, H)
    assert first.held == "" and np.abs(first.deflection).max() == pytest.approx(abs(value) / 350)
    late = desk.after(source, SILENT_STICK_S + H)
    assert late.held or not np.any(source.curve(late.deflection))
    if late.held:
        assert "has said nothing" in late.held
        cap.report({code: 0})
        assert desk.after(source, H).held == "", "it moves again once it was at rest"


def test_the_first_button_of_a_spacemouse_holds_the_arm(tmp_path: Path) -> None:
    cap = spacemouse(relative=False)
    desk = Desk(tmp_path, cap)
    source = desk.source("spacemouse")
    held = []
    for _ in range(2):
        cap.report(press=ecodes.BTN_0)
        held.append(desk.after(source, H).held)
        cap.report(release=ecodes.BTN_0)
        assert desk.after(source, H).held == held[-1]
    assert held == ["held by its first button; press it again to move", ""]


def test_what_was_unplugged_comes_back_under_another_number_and_must_rest_first(tmp_path: Path) -> None:
    pad, other = gamepad(), gamepad("Another pad")
    desk = Desk(tmp_path, pad, other)
    source = desk.source("gamepad", str(tmp_path / "event9"))
    desk.after(source, H)
    pad.report({ecodes.ABS_Y: -32768}, press=ecodes.BTN_TL)
    assert desk.after(source, H).held == ""
    pad.unplug()
    for _ in range(3):
        with pytest.raises(DriverError, match="Some pad .*event9.* is unplugged; plug it in again"):
            desk.after(source, LOOK_AGAIN_S)
    (tmp_path / "event20").touch()  # the kernel has made it, and its permissions are not set yet
    with pytest.raises(DriverError, match="unplugged"):
        desk.after(source, LOOK_AGAIN_S)
    pad.value[ecodes.ABS_Y] = -32768
    pad.down.add(ecodes.BTN_TL)
    pad.plug(tmp_path / "event20")
    found = desk.after(source, LOOK_AGAIN_S)
    assert found.held == "let go of it once" and "event20" in source.name
    pad.report({ecodes.ABS_Y: 0})
    assert desk.after(source, H).held == ""
    assert not other.handles


def test_a_buffer_that_overflows_is_asked_for_what_is_missing(tmp_path: Path) -> None:
    pad = gamepad()
    desk = Desk(tmp_path, pad)
    source = desk.source("gamepad")
    desk.after(source, H)
    pad.report(press=ecodes.BTN_TL)
    for k in range(200):
        pad.report({ecodes.ABS_Y: -150 * k})
    pad.report({ecodes.ABS_Y: 0})
    pad.report(release=ecodes.BTN_TL)
    found = desk.after(source, H)
    assert found.held and np.abs(found.deflection).max() < 1e-4


def test_the_force_rumbles_for_a_while_only_and_in_proportion(tmp_path: Path) -> None:
    pad = gamepad()
    desk = Desk(tmp_path, pad)
    source = desk.source("gamepad")
    sizes = []
    for part in (0.0, 0.1, 0.5, 1.0, 2.0, 0.0):
        desk.now += 0.1
        source.feel(part)
        source.feel(0.3)  # too soon: drivers are slow
        sizes.append(pad.effects[0] if pad.playing else None)
    strength = [size[0] for size in sizes if size is not None]
    assert sizes[0] is None and sizes[-1] is None and strength == sorted(strength) and strength[-1] == 65535
    assert len(pad.effects) == 1 and all(size[1] == RUMBLE_MS for size in sizes if size is not None)
    pad.unplug()
    desk.now += 0.1
    source.feel(1.0)
    mute = spacemouse(relative=True)
    desk = Desk(tmp_path, mute)
    source = desk.source("spacemouse")
    source.feel(1.0)
    assert not mute.effects


def test_what_cannot_be_a_master_is_said(tmp_path: Path) -> None:
    desk = Desk(tmp_path, gamepad(), gamepad("Second"), mouse())
    with pytest.raises(InputError, match="more than one gamepad; say --device .*event9.*event10"):
        desk.source("gamepad")
    with pytest.raises(InputError, match="a SpaceMouse was expected, but none of the 3 devices"):
        desk.source("spacemouse")
    with pytest.raises(InputError, match="event11 is no gamepad but 'Mouse'"):
        desk.source("gamepad", str(tmp_path / "event11"))
    with pytest.raises(DriverError, match="event99: no such file.*palpate teleop devices"):
        desk.source("gamepad", str(tmp_path / "event99"))
    (tmp_path / "event2").touch()
    with pytest.raises(DriverError, match="no permission: .*usermod"):
        desk.source("gamepad", str(tmp_path / "event2"))
    first = desk.source("gamepad", str(tmp_path / "event9"))
    with pytest.raises(DriverError, match="another program has taken it"):
        desk.source("gamepad", str(tmp_path / "event9"))
    first.close()
    desk.source("gamepad", str(tmp_path / "event9"))
    with pytest.raises(InputError, match="gamepad or spacemouse"):
        desk.source("glove")


def test_advice_says_what_to_do(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    assert "holds no device" in advice(connected(tmp_path, desk.computer.open), tmp_path)
    (tmp_path / "event0").touch()
    assert "usermod -aG input" in advice(connected(tmp_path, desk.computer.open), tmp_path)
    nowhere = tmp_path / "none"
    assert "In a container" in advice(connected(nowhere, desk.computer.open), nowhere, "gamepad")


def test_the_real_library_says_what_is_no_input_device(tmp_path: Path) -> None:
    plain = tmp_path / "event0"
    plain.write_bytes(b"")
    assert connected(tmp_path)[0].kind is None
    with pytest.raises(DriverError, match="it is no input device"):
        InputSource("gamepad", str(plain))


# --- real devices of the kernel ---------------------------------------------------------------------------------------

needs_kernel = pytest.mark.skipif(
    not os.access("/dev/uinput", os.R_OK | os.W_OK),
    reason="this kernel lets nobody make input devices (/dev/uinput); where it does, real ones are read here",
)


def until(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.002)


@pytest.fixture
def virtual() -> Iterator[Callable[[Hardware], evdev.UInput]]:
    made: list[evdev.UInput] = []

    def make(like: Hardware) -> evdev.UInput:
        kind = ecodes.EV_REL if like.relative else ecodes.EV_ABS
        events = {ecodes.EV_KEY: like.keys, kind: like.codes if like.relative else list(like.axes.items())}
        if like.rumble:
            events[ecodes.EV_FF] = [ecodes.FF_RUMBLE]
        made.append(evdev.UInput(events, name=like.name, vendor=0x1234, product=len(like.name)))
        until(lambda: os.access(made[-1].device.path, os.R_OK | os.W_OK))
        return made[-1]

    yield make
    for one in made:
        one.close()


@needs_kernel
def test_a_gamepad_of_the_kernel_moves_is_unplugged_and_comes_back(
    virtual: Callable[[Hardware], evdev.UInput],
) -> None:
    like = gamepad("palpate test pad", rumble=False)
    pad = virtual(like)
    source = InputSource("gamepad", pad.device.path)
    assert source.read().held.startswith("hold a shoulder")
    pad.write(ecodes.EV_KEY, ecodes.BTN_TL, 1)
    pad.write(ecodes.EV_ABS, ecodes.ABS_Y, -32768)
    pad.syn()
    until(lambda: source.read().held == "" and source.read().deflection[0] == 1.0)
    pad.close()

    def gone() -> bool:
        try:
            source.read()
        except DriverError as error:
            return "unplugged" in str(error)
        return False

    until(gone)
    virtual(like)
    until(lambda: not gone())
    assert source.read().held.startswith("hold a shoulder")
    source.close()


@needs_kernel
@pytest.mark.parametrize("relative", [True, False])
def test_a_spacemouse_of_the_kernel_is_let_go(
    virtual: Callable[[Hardware], evdev.UInput], relative: bool
) -> None:
    cap = virtual(spacemouse(relative=relative))
    source = InputSource("spacemouse", cap.device.path)
    kind = ecodes.EV_REL if relative else ecodes.EV_ABS

    def report(x: int, z: int) -> None:
        cap.write(kind, ecodes.REL_X, x)
        cap.write(kind, ecodes.REL_Z, z)
        cap.syn()

    def pushed() -> bool:
        report(-350, -175)
        return source.read().deflection == pytest.approx([0.0, 1.0, 0.5, 0.0, 0.0, 0.0])

    until(pushed)
    report(0, 0)
    until(lambda: not np.any(source.read().deflection))
    with pytest.raises(DriverError, match="another program has taken it"):
        InputSource("spacemouse", cap.device.path)
    source.close()


@needs_kernel
def test_a_gamepad_of_the_kernel_rumbles(virtual: Callable[[Hardware], evdev.UInput]) -> None:
    pad = virtual(gamepad("palpate test rumble"))
    source = InputSource("gamepad", pad.device.path)
    uploaded, played, over = [], [], threading.Event()

    def motors() -> None:
        while not over.is_set():
            event = pad.read_one()
            if event is None:
                time.sleep(0.001)
            elif event.type == ecodes.EV_UINPUT and event.code == ecodes.UI_FF_UPLOAD:
                upload = pad.begin_upload(event.value)
                upload.retval = 0
                uploaded.append(upload.effect.u.ff_rumble_effect.strong_magnitude)
                pad.end_upload(upload)
            elif event.type == ecodes.EV_UINPUT and event.code == ecodes.UI_FF_ERASE:
                erase = pad.begin_erase(event.value)
                erase.retval = 0
                pad.end_erase(erase)
            elif event.type == ecodes.EV_FF:
                played.append(event.value)

    thread = threading.Thread(target=motors, daemon=True)
    thread.start()
    try:
        source.feel(1.0)
        until(lambda: uploaded == [65535] and played == [1])
        time.sleep(0.1)
        source.feel(0.0)
        until(lambda: played[-1] == 0)
        source.close()
    finally:
        over.set()
        thread.join(LONG_S)


# --- keys of a terminal -----------------------------------------------------------------------------------------------


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The other end of a terminal that is this program's input."""
    here, there = pty.openpty()
    with os.fdopen(there) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield here
    os.close(here)


def test_keys_of_a_terminal_count_while_they_repeat(terminal: int) -> None:
    now = 0.0
    before = termios.tcgetattr(sys.stdin)
    with TerminalKeys(clock=lambda: now) as keys:
        assert not np.any(keys.read().deflection)
        for key, (axis, sign) in KEYS.items():
            os.write(terminal, key.upper().encode() + b"?\x1b[15~\x1b\x1bOP\xff")
            until(lambda axis=axis: bool(np.any(keys.read().deflection)))
            assert keys.read().deflection == pytest.approx(sign * np.eye(6)[axis])
            now += 0.1
            assert np.any(keys.read().deflection)
            now += 0.1
            assert not np.any(keys.read().deflection), "a terminal tells no release, so it counts as one"
        os.write(terminal, b"\x1b[A\x1bOC\x1b")  # arrows: forward and right, and half of the one to the left
        until(lambda: keys.read().deflection == pytest.approx([1.0, -1.0, 0.0, 0.0, 0.0, 0.0]))
        os.write(terminal, b"[D")
        until(lambda: keys.read().deflection == pytest.approx([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        keys.feel(1.0)
    assert termios.tcgetattr(sys.stdin) == before


def test_a_terminal_that_hangs_up_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = pty.openpty()
    with os.fdopen(there) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with TerminalKeys() as keys:
            os.close(here)
            with pytest.raises(DriverError, match="the terminal is gone"):
                until(lambda: bool(keys.read().held))


# --- in a run ---------------------------------------------------------------------------------------------------------


def test_a_gamepad_presses_a_wall_is_unplugged_and_goes_on(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
    from palpate.teleop.channel import Faults
    from palpate.teleop.session import Run, Wish
    from palpate.teleop.setups import build

    pad = gamepad()
    desk = Desk(tmp_path, pad)
    master = RateMaster(desk.source("gamepad"))
    setup = build("wall", device=master, stiffness=300.0)
    acts = {
        1500: lambda: pad.report({ecodes.ABS_Y: -32768}, press=ecodes.BTN_TL),
        2200: lambda: pad.report({ecodes.ABS_Y: 0}),
        2500: pad.unplug,
        2800: lambda: pad.plug(tmp_path / "event30"),
        3400: lambda: pad.report({ecodes.ABS_Y: -20000, ecodes.ABS_RX: -20000}, press=ecodes.BTN_TR),
        4200: lambda: pad.report({ecodes.ABS_Y: 0, ecodes.ABS_RX: 0}),
    }

    def tap(k: int, run: Run) -> Wish:
        desk.now = run.time[k]
        acts.get(k, lambda: None)()
        return Wish(Faults())

    out = setup.run(seconds=4.4, tap=tap)
    reasons = [text for _, text in out.reasons]
    assert reasons == [f"device: Some pad ({tmp_path / 'event9'}) is unplugged; plug it in again"]
    assert out.reasons[0][0] == pytest.approx(2.501) and not out.holding
    pressing = slice(2400, 2500)
    true = np.linalg.norm(out.true[pressing], axis=1).mean()
    assert true > 3.0 and np.linalg.norm(out.felt[pressing], axis=1).mean() == pytest.approx(true, rel=0.1)
    assert pad.effects[0][0] > 20000, "it rumbles"
    away = slice(2501, 2801)
    assert np.ptp(out.reference[away], axis=0).max() < 1e-3, "held"
    assert np.abs(np.diff(out.reference, axis=0)).max() <= 1.2e-4, (
        "no jump, and never beyond the speed of the stick"
    )
    assert out.reference[-1, 0] > out.reference[3300, 0] + 5e-3, "it comes back"
    turned = turn_between(out.reference_turn[-1], out.reference_turn[0])
    assert turned[2] > 0.05 and np.abs(turned[:2]).max() < 0.01, "to the left, about up"


def press_keys(terminal: int, process: subprocess.Popen[str]) -> None:
    while process.poll() is None:
        try:
            os.write(terminal, b"w")
        except OSError:
            return
        time.sleep(0.03)


@pytest.mark.timeout(600)
def test_keys_move_the_arm_from_the_command_line(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
    pytest.importorskip("rosbags", reason="palpate[logs] is not installed")
    from palpate.logs import Log

    here, there = pty.openpty()
    arguments = ["run", "free", "--master", "keyboard", "--seconds", "2", "--json", "--no-report"]
    process = subprocess.Popen(
        [sys.executable, "-m", "palpate.cli", "teleop", *arguments, "--out", str(tmp_path)],
        stdin=there,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    typing = threading.Thread(target=press_keys, args=(here, process), daemon=True)
    typing.start()
    try:
        said, complaints = process.communicate(timeout=LONG_S)
    finally:
        process.kill()
        typing.join(LONG_S)
        os.close(there)
        os.close(here)
    assert process.returncode == 0, complaints
    assert json.loads(said)["settings"]["master"] == "keyboard, keys of this terminal"
    x = Log.open(tmp_path / "teleop.mcap").signals["master_position"].value
    assert x[-1, 0] > 0.02 and np.abs(x[:, 1:]).max() == 0.0


@pytest.mark.timeout(600)
def test_a_process_of_its_own_is_moved_by_keys_and_says_what_is_felt(tmp_path: Path) -> None:
    from palpate.teleop import make_key

    here, there = pty.openpty()
    arguments = ["master", "--master", "keyboard", "--seconds", "2", "--key", str(make_key(tmp_path / "key"))]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "palpate.cli", "teleop", *arguments],
            stdin=there,
            capture_output=True,
            text=True,
            timeout=LONG_S,
            check=False,
        )
    finally:
        os.close(there)
        os.close(here)
    assert done.returncode == 0, done.stderr
    assert "keys of this terminal: w s or arrows" in done.stdout and "; felt 0.0 N" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--master", "glove"], "--master"),
        (["--master", "gampad"], "did you mean 'gamepad'"),
        (["--master", "keyboard"], "needs a terminal"),
        (["--device", "/dev/input/event0"], "--device"),
        (["--master", "keyboard", "--device", "/dev/input/event0"], "--device"),
        (["--speed", "0.2"], "--speed"),
        (["--master", "gamepad", "--speed", "-1"], "--speed"),
        (["--master", "gamepad", "--device", "/dev/null"], "it is no input device"),
        (["--master", "spacemouse", "--device", "nowhere"], "nowhere: no such file"),
    ],
)
@pytest.mark.parametrize("verb", ["run", "master"])
def test_wrong_words_are_one_line(
    verb: str,
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", open(os.devnull))
    assert main(["teleop", verb, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_devices_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["teleop", "devices"]) == 0
    said = capsys.readouterr().out
    assert all(f"--master {name}" in said for name in KINDS)
    assert main(["teleop", "devices", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {"devices", "advice"}
