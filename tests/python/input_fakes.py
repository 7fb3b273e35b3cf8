"""What evdev.InputDevice is to its user, without a kernel: what a driver reports comes out as the kernel would tell it.

An axis that has not changed is not told, relative motion of 0 is not told, a packet of nothing is not told, and a
buffer that overflows says so (Linux, drivers/input/input.c and evdev.c).
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import NamedTuple

from evdev import AbsInfo, InputEvent, ecodes
from evdev.device import DeviceInfo

BUFFER = 64


class Hardware:
    """One device, plugged in or not, whatever number it has."""

    def __init__(
        self,
        name: str,
        keys: tuple[int, ...],
        axes: dict[int, AbsInfo] | tuple[int, ...],
        *,
        rumble: bool = False,
    ) -> None:
        self.name, self.keys = name, keys
        self.relative = not isinstance(axes, dict)
        self.info = DeviceInfo(3, 0x1234, len(name), 1)
        self.rumble = rumble
        self.axes = dict(axes) if isinstance(axes, dict) else {}
        self.codes = tuple(axes)
        self.value = {code: info.value for code, info in self.axes.items()}
        self.down: set[int] = set()
        self.path: Path | None = None
        self.handles: list[Handle] = []
        self.grabbed: Handle | None = None
        self.effects: dict[int, tuple[int, int]] = {}
        self.playing: set[int] = set()

    def plug(self, path: Path) -> None:
        path.touch()
        self.path = path

    def unplug(self) -> None:
        assert self.path is not None
        self.path.unlink()
        self.path, self.grabbed = None, None
        self.down.clear()
        self.value = {code: info.value for code, info in self.axes.items()}
        for handle in self.handles:
            handle.alive = False
        self.handles = []

    def report(
        self, axes: dict[int, int] | None = None, *, press: int | None = None, release: int | None = None
    ) -> None:
        """A packet of the driver."""
        packet = []
        for code, value in (axes or {}).items():
            if self.relative:
                if value:
                    packet.append((ecodes.EV_REL, code, value))
            elif self.value[code] != value:
                self.value[code] = value
                packet.append((ecodes.EV_ABS, code, value))
        for key, value in ((press, 1), (release, 0)):
            if key is not None and (key in self.down) != bool(value):
                (self.down.add if value else self.down.discard)(key)
                packet.append((ecodes.EV_KEY, key, value))
        if packet:
            for handle in self.handles:
                handle.take([*packet, (ecodes.EV_SYN, ecodes.SYN_REPORT, 0)])


class Handle:
    """An open one; what palpate uses of evdev.InputDevice, with its types."""

    def __init__(self, hardware: Hardware, path: str) -> None:
        self._hardware, self.path = hardware, path
        self.name, self.info = hardware.name, hardware.info
        self.alive, self.closed = True, False
        self._waiting: list[tuple[int, int, int]] = []

    def take(self, packet: list[tuple[int, int, int]]) -> None:
        if self._hardware.grabbed not in (None, self):
            return
        if len(self._waiting) + len(packet) > BUFFER:
            self._waiting = [(ecodes.EV_SYN, ecodes.SYN_DROPPED, 0), packet[-2], packet[-1]]
        else:
            self._waiting += packet

    def _there(self) -> None:
        if not self.alive:
            raise OSError(errno.ENODEV, "No such device")

    def capabilities(self, *, absinfo: bool) -> dict[int, list[int]]:
        assert not absinfo
        hardware = self._hardware
        found = {
            ecodes.EV_SYN: [0, 3],
            ecodes.EV_KEY: list(hardware.keys),
            ecodes.EV_REL if hardware.relative else ecodes.EV_ABS: list(hardware.codes),
        }
        return found | ({ecodes.EV_FF: [ecodes.FF_RUMBLE]} if hardware.rumble else {})

    def absinfo(self, code: int) -> AbsInfo:
        self._there()
        return self._hardware.axes[code]._replace(value=self._hardware.value[code])

    def active_keys(self) -> list[int]:
        self._there()
        return sorted(self._hardware.down)

    def grab(self) -> None:
        self._there()
        if self._hardware.grabbed is not None:
            raise OSError(errno.EBUSY, "Device or resource busy")
        self._hardware.grabbed = self

    def read(self):
        self._there()
        if not self._waiting:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        events, self._waiting = self._waiting, []
        return (InputEvent(0, 0, *event) for event in events)

    def upload_effect(self, effect) -> int:
        self._there()
        id = len(self._hardware.effects) if effect.id == -1 else effect.id
        rumble = effect.u.ff_rumble_effect
        self._hardware.effects[id] = (rumble.strong_magnitude, effect.ff_replay.length)
        return id

    def write(self, kind: int, code: int, value: int) -> None:
        self._there()
        assert kind == ecodes.EV_FF
        (self._hardware.playing.add if value else self._hardware.playing.discard)(code)

    def close(self) -> None:
        self.closed = True
        if self in self._hardware.handles:
            self._hardware.handles.remove(self)
        if self._hardware.grabbed is self:
            self._hardware.grabbed = None
            self._hardware.playing.clear()


class Computer(NamedTuple):
    """A folder of devices, and what opens them."""

    folder: Path
    hardware: list[Hardware]

    def open(self, path: str) -> Handle:
        if not Path(path).exists():
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", path)
        for one in self.hardware:
            if one.path == Path(path):
                handle = Handle(one, path)
                one.handles.append(handle)
                return handle
        raise PermissionError(errno.EACCES, "Permission denied", path)


STICK = AbsInfo(0, -32768, 32767, 16, 128, 0)
BYTE = AbsInfo(128, 0, 255, 0, 15, 0)
HAT = AbsInfo(0, -1, 1, 0, 0, 0)
CAP = AbsInfo(0, -350, 350, 0, 0, 0)
SIX = (ecodes.ABS_X, ecodes.ABS_Y, ecodes.ABS_Z, ecodes.ABS_RX, ecodes.ABS_RY, ecodes.ABS_RZ)
PAD_KEYS = (ecodes.BTN_SOUTH, ecodes.BTN_EAST, ecodes.BTN_TL, ecodes.BTN_TR)


def gamepad(name: str = "Some pad", *, rumble: bool = True) -> Hardware:
    """As the kernel's specification has it: triggers are Z and RZ."""
    trigger = AbsInfo(0, 0, 255, 0, 0, 0)
    axes = {
        ecodes.ABS_X: STICK,
        ecodes.ABS_Y: STICK,
        ecodes.ABS_Z: trigger,
        ecodes.ABS_RX: STICK,
        ecodes.ABS_RY: STICK,
        ecodes.ABS_RZ: trigger,
        ecodes.ABS_HAT0X: HAT,
        ecodes.ABS_HAT0Y: HAT,
    }
    return Hardware(name, PAD_KEYS, axes, rumble=rumble)


def old_gamepad() -> Hardware:
    """A cheap one: bytes, the right stick as Z and RZ."""
    axes = dict.fromkeys((ecodes.ABS_X, ecodes.ABS_Y, ecodes.ABS_Z, ecodes.ABS_RZ), BYTE)
    return Hardware("Old pad", PAD_KEYS, axes)


def spacemouse(*, relative: bool) -> Hardware:
    """As the older models report, or as the newer ones do."""
    keys = (ecodes.BTN_0, ecodes.BTN_1)
    return Hardware("Space cap", keys, SIX if relative else dict.fromkeys(SIX, CAP))


def motion_sensors() -> Hardware:
    """What some gamepads are besides: six axes and no key."""
    return Hardware("Some pad Motion Sensors", (), dict.fromkeys(SIX, STICK))


def mouse() -> Hardware:
    return Hardware("Mouse", (ecodes.BTN_LEFT,), (ecodes.REL_X, ecodes.REL_Y))
