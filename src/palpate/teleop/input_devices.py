"""Gamepads and SpaceMice as Linux gives them, /dev/input/event*: found, read, unplugged, plugged in again."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ..errors import DriverError, InputError, MissingExtraError
from .rate_control import AXES, Curve, Reading

if TYPE_CHECKING:
    import evdev

FOLDER = Path("/dev/input")
FULL_CAP = 350.0
"""what a SpaceMouse that reports relative motion gives at its end, as its HID descriptor says"""
SILENT_CAP_S = 0.1
"""a SpaceMouse that reports relative motion says nothing at rest, and something every 8 to 16 ms else [s]"""
SILENT_STICK_S = 5.0
"""deflected and without any event for so long, a stick is taken for stuck: at full speed it has crossed the workspace
by then, and a stick that is held by a hand trembles [s]"""
LOOK_AGAIN_S = 0.5
"""how often one that was unplugged is looked for [s]"""
FEEL_S = 0.05
"""how often rumble is changed [s]"""
RUMBLE_MS = 300
"""how long it goes on where nobody changes it: a program that has died does not rumble"""
WEAKEST = 0.15
"""part at which rumble motors begin to turn"""

Open: TypeAlias = "Callable[[str], evdev.InputDevice[str]]"


def _evdev() -> Any:
    try:
        import evdev
    except ImportError:
        raise MissingExtraError("gamepad", "reading a gamepad or a SpaceMouse") from None
    return evdev


def _open(path: str) -> evdev.InputDevice[str]:
    found: evdev.InputDevice[str] = _evdev().InputDevice(path)
    return found


# of <linux/input-event-codes.h>, for what is said below is about them, and the library is not always there
_EV_SYN, _EV_KEY, _EV_REL, _EV_ABS, _EV_FF = 0x00, 0x01, 0x02, 0x03, 0x15
_SYN_REPORT, _SYN_DROPPED = 0, 3
_X, _Y, _Z, _RX, _RY, _RZ, _HAT0X, _HAT0Y = 0, 1, 2, 3, 4, 5, 0x10, 0x11
_BTN_0, _BTN_SOUTH, _BTN_TL, _BTN_TR = 0x100, 0x130, 0x136, 0x137
_FF_RUMBLE = 0x50

_Has: TypeAlias = Mapping[int, frozenset[int]]
"""event type to the codes that a device has"""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of device that can be a master.

    Attributes:
        name: of the option.
        text: for people.
        usage: how it is used, for people.
        curve: that suits it.
        axes: what a device has to its axes, code to (axis, sign); None: it is not of this kind.
        enable: buttons one of which must be held to move; empty: none must.
        toggle: the button that holds it and lets it go; None: there is none.
    """

    name: str
    text: str
    usage: str
    curve: Curve
    axes: Callable[[_Has], dict[int, tuple[int, float]] | None]
    enable: frozenset[int] = frozenset()
    toggle: int | None = None


def _gamepad(has: _Has) -> dict[int, tuple[int, float]] | None:
    """As the kernel's gamepad specification orders them: negative is left and up, which is forward."""
    sticks = has.get(_EV_ABS, frozenset())
    if _BTN_SOUTH not in has.get(_EV_KEY, frozenset()) or not {_X, _Y} <= sticks:
        return None
    # drivers older than the specification report the right stick as Z and RZ, which are triggers elsewhere
    right = (_RX, _RY) if {_RX, _RY} <= sticks else (_Z, _RZ)
    found = {
        _Y: (0, -1.0),
        _X: (1, -1.0),
        right[1]: (2, -1.0),
        right[0]: (5, -1.0),
        _HAT0X: (3, 1.0),
        _HAT0Y: (4, -1.0),
    }
    return {code: to for code, to in found.items() if code in sticks}


def _spacemouse(has: _Has) -> dict[int, tuple[int, float]] | None:
    """Right, towards the hand, down, and the turns about these, right-handed; relative or absolute, by the model."""
    six = {_X, _Y, _Z, _RX, _RY, _RZ}
    keys = has.get(_EV_KEY, frozenset())
    if _BTN_0 not in keys or _BTN_SOUTH in keys:
        return None
    if not (six <= has.get(_EV_REL, frozenset()) or six <= has.get(_EV_ABS, frozenset())):
        return None
    return {
        _Y: (0, -1.0),
        _X: (1, -1.0),
        _Z: (2, -1.0),
        _RY: (3, -1.0),
        _RX: (4, -1.0),
        _RZ: (5, -1.0),
    }


KINDS = {
    kind.name: kind
    for kind in (
        Kind(
            "gamepad",
            "a gamepad",
            "hold a shoulder button (LB, RB, L1, R1) to move: left stick forward, back, left and right, right stick up "
            "and down, and turns about up; the cross tips and rolls",
            Curve(dead=0.12, expo=0.6),
            _gamepad,
            enable=frozenset((_BTN_TL, _BTN_TR)),
        ),
        Kind(
            "spacemouse",
            "a SpaceMouse",
            "push, pull, lift and twist the cap to move; the first button holds the arm and lets it go again",
            Curve(dead=0.08, expo=0.4),
            _spacemouse,
            toggle=_BTN_0,
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Found:
    """An input device of this computer."""

    path: str
    name: str
    """of the maker; empty: it cannot be read"""
    kind: str | None
    """gamepad or spacemouse; None: neither, or unknown"""
    problem: str = ""
    """why it cannot be read"""


def _has(device: evdev.InputDevice[str]) -> dict[int, frozenset[int]]:
    return {kind: frozenset(codes) for kind, codes in device.capabilities(absinfo=False).items()}


def _kind(device: evdev.InputDevice[str]) -> str | None:
    has = _has(device)
    return next((kind.name for kind in KINDS.values() if kind.axes(has) is not None), None)


def _number(path: Path) -> int:
    return int(re.sub(r"\D", "", path.name) or 0)


def connected(folder: Path = FOLDER, open: Open = _open) -> list[Found]:
    """All input devices, in the kernel's order.

    Args:
        folder: where they are.
        open: opens one.

    Raises:
        MissingExtraError: evdev is not installed.
    """
    if open is _open:
        _evdev()
    found = []
    for path in map(str, sorted(folder.glob("event*"), key=_number)):
        try:
            device = open(path)
        except OSError as error:
            found.append(Found(path, "", None, _problem(error)))
            continue
        try:
            found.append(Found(path, device.name, _kind(device)))
        finally:
            device.close()
    return found


def _problem(error: OSError) -> str:
    if error.errno in (errno.EACCES, errno.EPERM):
        return "no permission"
    return (error.strerror or str(error)).lower()


def advice(found: list[Found], folder: Path = FOLDER, kind: str | None = None) -> str:
    """What to do where nothing that can be a master was found; empty: something was.

    Args:
        found: see :func:`connected`.
        folder: where it was looked for.
        kind: gamepad or spacemouse; None: either.
    """
    if any(f.kind is not None and kind in (None, f.kind) for f in found):
        return ""
    what = "a gamepad or a SpaceMouse" if kind is None else KINDS[kind].text
    if not folder.is_dir():
        return (
            f"there is no {folder} here: no kernel input devices. In a container, start it with "
            f"--device {folder} (docker) and try again"
        )
    closed = sum(f.problem == "no permission" for f in found)
    if closed:
        return (
            f"{closed} of {len(found)} devices in {folder} may not be read by you, {what} may be among them: "
            "`sudo usermod -aG input $USER` and log in again, or a udev rule (docs/teleoperation.md)"
        )
    seen = f"none of the {len(found)} devices in {folder} is one" if found else f"{folder} holds no device"
    return f"{what} was expected, but {seen}: plug it in, or pair it, and look with palpate teleop devices"


def _close(device: evdev.InputDevice[str]) -> None:
    with contextlib.suppress(OSError):  # of one that is gone the kernel says so here too
        device.close()


class InputSource:
    """A gamepad or a SpaceMouse. It moves once it has been at rest; what was unplugged is looked for by itself, under
    whatever number it comes back.

    It is taken for this program alone, for a SpaceMouse is a mouse to a desktop.

    Args:
        kind: gamepad or spacemouse.
        path: which one; None: the only one.
        folder: where devices are.
        open: opens one.
        clock: what time it is [s].

    Raises:
        InputError: there is no such device, more than one, or another kind of device at this path.
        DriverError: it cannot be opened, or another program has it.
        MissingExtraError: evdev is not installed.
    """

    def __init__(
        self,
        kind: str,
        path: str | None = None,
        *,
        folder: Path = FOLDER,
        open: Open = _open,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if kind not in KINDS:
            raise InputError(f"expected {' or '.join(KINDS)}, got {kind!r}")
        self._kind, self._folder, self._open, self._clock = KINDS[kind], folder, open, clock
        self.usage, self.curve = self._kind.usage, self._kind.curve
        self._device: evdev.InputDevice[str] | None = None
        self._looked, self._gone = -np.inf, ""
        self._take(self._only() if path is None else path)

    # --- coming and going ----------------------------------------------------------------------------------------

    def _only(self) -> str:
        found = connected(self._folder, self._open)
        mine = [f for f in found if f.kind == self._kind.name]
        if not mine:
            raise InputError(advice(found, self._folder, self._kind.name))
        if len(mine) > 1:
            listed = ", ".join(f"{f.path} ({f.name})" for f in mine)
            raise InputError(f"there is more than one {self._kind.name}; say --device with one of {listed}")
        return mine[0].path

    def _take(self, path: str) -> None:
        try:
            device = self._open(path)
        except OSError as error:
            hint = ""
            if error.errno in (errno.EACCES, errno.EPERM):
                hint = ": `sudo usermod -aG input $USER` and log in again, or a udev rule (docs/teleoperation.md)"
            elif error.errno == errno.ENOTTY:
                hint = ": it is no input device; see palpate teleop devices"
            else:
                hint = "; see palpate teleop devices"
            raise DriverError(f"{path}: {_problem(error)}{hint}") from None
        axes = self._kind.axes(_has(device))
        if axes is None:
            name = device.name
            device.close()
            raise InputError(
                f"{path} is no {self._kind.name} but {name!r}; palpate teleop devices lists which is which"
            )
        self._axes = axes
        try:
            device.grab()
            self._begin(device)
        except OSError as error:
            _close(device)
            if error.errno != errno.EBUSY:
                raise DriverError(f"{path}: {_problem(error)}") from None
            raise DriverError(
                f"{path}: another program has taken it (spacenavd, Steam, another palpate?); end that one"
            ) from None
        self._device = device
        self.name = f"{device.name} ({path})"
        self._same = (device.name, device.info)

    def _begin(self, device: evdev.InputDevice[str]) -> None:
        """Of what it says nothing is known yet but what the kernel remembers."""
        has = _has(device)
        self._relative = {_X, _Y, _Z, _RX, _RY, _RZ} <= has.get(_EV_REL, frozenset())
        self._u = np.zeros(AXES)
        self._packet: set[int] = set()
        self._dropped = self._toggled = self._rested = self._rumbles = False
        self._why = "let go of it once"
        self._seen = self._clock()
        self._groups = [-np.inf, -np.inf]
        self._effect: int | None = None
        self._can_rumble = _FF_RUMBLE in has.get(_EV_FF, frozenset()) and os.access(device.path, os.W_OK)
        self._felt_at = -np.inf
        self._scale: dict[int, tuple[float, float]] = {}
        if not self._relative:
            for code in self._axes:
                info = device.absinfo(code)
                half = 0.5 * (info.max - info.min)
                self._scale[code] = 0.5 * (info.max + info.min), half if half > 0.0 else np.inf
        self._ask(device)

    def _ask(self, device: evdev.InputDevice[str]) -> None:
        """What the kernel remembers of it."""
        self._keys = set(device.active_keys())
        for code in self._scale:
            self._absolute(code, device.absinfo(code).value)

    def _look(self) -> None:
        """Whether it is back."""
        now = self._clock()
        if now - self._looked < LOOK_AGAIN_S:
            return
        self._looked = now
        for place in sorted(self._folder.glob("event*"), key=_number):
            try:
                device = self._open(str(place))
            except OSError:
                continue  # another one, or its permissions are not set yet
            same = (device.name, device.info) == self._same and self._kind.axes(_has(device)) is not None
            device.close()
            if same:
                try:
                    self._take(str(place))
                except DriverError as error:
                    self._gone = str(error)
                return

    def _lose(self) -> None:
        """It is gone."""
        if self._device is not None:
            _close(self._device)
        self._device, self._looked = None, self._clock()
        self._gone = f"{self.name} is unplugged; plug it in again"

    # --- events --------------------------------------------------------------------------------------------------

    def _absolute(self, code: int, value: int) -> None:
        if code in self._axes:
            axis, sign = self._axes[code]
            centre, half = self._scale[code]
            self._u[axis] = sign * min(1.0, max(-1.0, (value - centre) / half))

    def _events(self, device: evdev.InputDevice[str]) -> None:
        try:
            events = list(device.read())
        except BlockingIOError:
            return
        self._seen = self._clock()
        for event in events:
            if event.type == _EV_SYN and event.code == _SYN_DROPPED:
                self._dropped = True
            elif event.type == _EV_SYN and event.code == _SYN_REPORT:
                if self._dropped:  # the kernel's buffer was full: what is missing is asked for
                    self._dropped = False
                    self._ask(device)
                self._end_packet()
            elif self._dropped:
                continue
            elif event.type == _EV_ABS and not self._relative:
                self._absolute(event.code, event.value)
            elif event.type == _EV_REL and self._relative and event.code in self._axes:
                axis, sign = self._axes[event.code]
                self._u[axis] = sign * min(1.0, max(-1.0, event.value / FULL_CAP))
                self._packet.add(axis)
            elif event.type == _EV_KEY:
                self._key(event.code, event.value)

    def _key(self, code: int, value: int) -> None:
        if value == 1 and code == self._kind.toggle:
            self._toggled = not self._toggled
        (self._keys.add if value else self._keys.discard)(code)

    def _end_packet(self) -> None:
        """Relative motion of 0 is not told: what lacks in a packet of places, or in one of turns, is at rest."""
        for group, axes in enumerate(({0, 1, 2}, {3, 4, 5})):
            if self._packet & axes:
                self._u[list(axes - self._packet)] = 0.0
                self._groups[group] = self._seen
        self._packet.clear()

    def read(self) -> Reading:
        """What it says now.

        Raises:
            DriverError: it is unplugged, until it is back.
        """
        if self._device is None:
            self._look()
        if self._device is not None:
            try:
                self._events(self._device)
            except OSError:
                self._lose()
        if self._device is None:
            raise DriverError(self._gone)
        held = self._held()
        return Reading(self._u.copy(), held)

    def _held(self) -> str:
        """What must be done before it moves; what has been silent for too long is at rest from here on."""
        now = self._clock()
        if self._relative:
            for group, last in enumerate(self._groups):
                if now - last > SILENT_CAP_S:
                    self._u[3 * group : 3 * group + 3] = 0.0
        resting = not np.any(self.curve(self._u))
        if not resting and now - self._seen > SILENT_STICK_S:
            self._rested = False
            self._why = f"it has said nothing for {SILENT_STICK_S:g} s: let go of it once"
        self._rested = self._rested or resting
        if not self._rested:
            return self._why
        if self._kind.enable and not self._kind.enable & self._keys:
            return "hold a shoulder button (LB, RB, L1, R1) to move"
        return "held by its first button; press it again to move" if self._toggled else ""

    # --- the force -----------------------------------------------------------------------------------------------

    def feel(self, part: float) -> None:
        """Rumble with a part of all that it can, 0 to 1; one that cannot rumble does nothing."""
        now = self._clock()
        if self._device is None or not self._can_rumble or now - self._felt_at < FEEL_S:
            return
        self._felt_at = now
        size = 0 if part < 0.02 else round(65535 * (WEAKEST + (1.0 - WEAKEST) * min(1.0, part)))
        if size == 0 and not self._rumbles:
            return
        try:
            self._rumble(self._device, size)
        except OSError as error:
            if error.errno == errno.ENODEV:
                return  # unplugged: read() says so
            self._can_rumble = False  # a driver that promises more than it does

    def _rumble(self, device: evdev.InputDevice[str], size: int) -> None:
        ff = _evdev().ff
        how = ff.EffectType(ff_rumble_effect=ff.Rumble(strong_magnitude=size, weak_magnitude=size))
        id = -1 if self._effect is None else self._effect
        effect = ff.Effect(_FF_RUMBLE, id, 0, ff.Trigger(0, 0), ff.Replay(RUMBLE_MS, 0), how)
        self._effect = device.upload_effect(effect)
        device.write(_EV_FF, self._effect, 1 if size else 0)
        self._rumbles = size > 0

    def close(self) -> None:
        """Let go of it; it stops rumbling."""
        if self._device is not None:
            self._device.close()
            self._device = None
