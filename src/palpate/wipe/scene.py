"""Two arms, a loose whiteboard on a table, a felt eraser and a camera, in MuJoCo.

The eraser's arm stands in the world's origin, so its base axes are the world's. The board lies on a table that may be
tilted; it stands on four feet and slides when pushed harder than their friction. Felt is a grid of pads, each on a
spring along the tool's z axis with one point of contact: their forces are the pressure that takes ink off, so that an
eraser that sits badly leaves residue. The other arm's gripper closes on the board's edge if it is there, and is then a
stiff but not rigid hold; closing and opening of fingers is not simulated. The ink is a texture of the board in the
camera's picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array
from ..errors import InputError, PalpateError
from ..robots import load as load_robot
from ..simulate import Plant, _model
from ..vision import Camera
from .ink import InkLayer
from .strokes import Eraser

FRAME = 0.02
"""width of the board's frame [m]"""
THICK = 0.012
"""of the board [m]"""
FOOT = 0.004
"""radius of its feet [m]"""
STEM = 0.10
"""from the flange to the felt's face [m]"""
BLOCK = 0.15
"""mass of the eraser without its pads [kg]"""
PADS = (2, 4)
"""along the tool's x and y"""
PAD = 0.004
"""mass of a pad [kg], and radius of its ball [m]"""
STIFFNESS = 600.0
"""of the whole felt [N/m]"""
TRAVEL = 0.012
"""of a pad [m]"""
WHITE = 0.85
"""part of the light that the clean surface gives back, so that the cell's lamps do not burn it out"""
BRIGHT = 240.0
"""the camera's exposure keeps all but a hundredth of the picture below this, of 255"""
MAGNET = (0.014, 0.009)
"""radius and height of a magnet [m]"""
GRIP = 0.012
"""the gripper's point must be so near the board's rim to hold it [m]"""
HOLDER = (1.55, 0.0, 0.0)
"""base of the other arm, which faces the first [m]"""
TICK_NS = 2_000_000
"""the ink is rubbed so often [ns]"""


@dataclass(frozen=True, slots=True)
class Setting:
    """How board, table, light and camera are."""

    centre: tuple[float, float, float] = (0.58, 0.0, 0.15)
    """of the writing surface, world [m]"""
    turn: float = 0.0
    """of the board about the vertical; 0: its top edge is away from the eraser's arm [rad]"""
    tilt: float = 0.0
    """of the table, the edge away from the eraser's arm up [rad]"""
    magnets: tuple[tuple[float, float], ...] = ()
    """where magnets are, board coordinates [m]: discs of MAGNET that the felt cannot pass"""
    mass: float = 1.5
    """of the board [kg]"""
    friction: float = 0.4
    """of its feet on the table"""
    felt_friction: float = 0.4
    """of the felt on the board"""
    noise: float = 2.0
    """standard deviation of a pixel, of 255"""
    blur: float = 0.6
    """standard deviation of the lens's blur [pixel]"""
    lamps: float = 0.15
    """light, relative: each picture is this much brighter or darker and more or less warm by chance"""
    picture: tuple[int, int] = (1280, 720)
    """width and height [pixel]"""
    seed: int = 0
    """of noise and light"""

    def __post_init__(self) -> None:
        for name in ("mass", "friction", "felt_friction"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"setting: {name} must be finite and > 0, got {value!r}")
        for name in ("noise", "blur", "lamps"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"setting: {name} must be finite and >= 0, got {value!r}")
        if np.asarray(self.magnets, dtype=object).size and np.shape(self.magnets)[1:] != (2,):
            raise InputError(f"setting: magnets must be places (x, y) [m], got {self.magnets!r}")
        if not abs(self.tilt) <= math.radians(45.0):
            raise InputError(f"setting: tilt must be at most 45 degrees (0.785 rad), got {self.tilt!r} rad")


class BoardScene:
    """The simulated truth; what a robot would know of it are joint positions, torques and pictures.

    Args:
        ink: what is on the board, and its size; it changes as the eraser rubs.
        setting: None: as the defaults say.
        eraser: None: felt of 50 mm by 110 mm.
        arms: the eraser's and the holder's arm; None: two LBR iiwa 7.

    Raises:
        InputError: a setting is out of range.
        MissingExtraError: mujoco is not installed.
    """

    def __init__(
        self,
        ink: InkLayer,
        setting: Setting | None = None,
        *,
        eraser: Eraser | None = None,
        arms: tuple[Arm, Arm] | None = None,
    ) -> None:
        self.ink = ink
        self.setting = setting or Setting()
        self.eraser = eraser or Eraser()
        first, second = arms or (load_robot("kuka_lbr_iiwa7"), load_robot("kuka_lbr_iiwa7"))
        first, second = (a.replace(grasp=np.array([0.0, 0.0, STEM])) for a in (first, second))
        self.arms = (_fitted(first, self.eraser), second)
        """the eraser's with the eraser's mass in its last link and the grasp point on the felt's face; the holder's
        with the grasp point between the fingers"""
        self._mj = _model.mujoco()
        self._table = _table(self.setting)
        self._plant = Plant(
            first, timestep=5e-4, integrator="discrete", contacts=True, limits=True, scene=self._build
        )
        model = self._plant.model
        _model.write_arm(model, self.arms[1], self._other)
        self._mj.mj_setConst(model, self._mj.MjData(model))
        self._board = model.body("board").id
        self._joint = model.joint("board").qposadr[0]
        n = self.arms[1].n
        at = model.joint(f"holder:{self.arms[1].joints[0].name}")
        self._second = slice(at.qposadr[0], at.qposadr[0] + n), slice(at.dofadr[0], at.dofadr[0] + n)
        self._pads = np.array([model.geom(f"pad:{k}").id for k in range(PADS[0] * PADS[1])])
        self._pad_of = np.full(model.ngeom, -1)
        self._pad_of[self._pads] = np.arange(len(self._pads))
        self._grip = model.equality("grip").id
        self._hand = model.body("holder:payload").id
        self._tool = model.body("arm:payload").id
        self._texture = model.texture("ink").id
        self._solids = (
            self._shapes("arm:"),
            self._shapes("holder:"),
            [model.geom("table").id, model.geom("board").id],
        )
        self._mirror: Any = None
        self.torque_lost = False
        """set it: the joint torque sensors of the eraser's arm say nothing any more"""
        self._lens: _Lens | None = None
        self._aside: _Lens | None = None
        self._rng = np.random.default_rng(self.setting.seed)
        self._rubbed: tuple[Array, float] | None = None
        self.reset(np.zeros(first.n), np.zeros(n))

    # -- time ------------------------------------------------------------------

    def reset(self, q_eraser: npt.ArrayLike, q_holder: npt.ArrayLike) -> None:
        """Both arms at rest in these poses [rad], the board in its place, nothing held; the ink stays as it is.

        Raises:
            InputError: a wrong shape.
        """
        other = np.asarray(q_holder, dtype=np.float64)
        if other.shape != (self.arms[1].n,) or not np.all(np.isfinite(other)):
            raise InputError(f"q of the holder must be ({self.arms[1].n},) and finite, got {other.shape}")
        self._plant.reset(q_eraser)
        self._plant.data.qpos[self._second[0]] = other
        self._mj.mj_forward(self._plant.model, self._plant.data)
        self._rng = np.random.default_rng(self.setting.seed)
        self._rubbed = None

    def step(self, eraser: npt.ArrayLike, holder: npt.ArrayLike, duration_ns: int) -> None:
        """Hold the motor torques (n,) of both arms [N m] for a while [ns].

        Raises:
            InputError: a wrong shape, a duration that is not positive, or the simulation left the finite numbers.
        """
        other = np.asarray(holder, dtype=np.float64)
        if other.shape != (self.arms[1].n,) or not np.all(np.isfinite(other)):
            raise InputError(
                f"torque of the holder must be ({self.arms[1].n},) and finite, got {other.shape}"
            )
        self._plant.data.qfrc_applied[self._second[1]] = other
        left = int(duration_ns)
        while True:
            # whole ticks of the clock, so that the ink does not depend on how time is cut
            part = min(left, TICK_NS - self.time_ns % TICK_NS)
            self._plant.step(eraser, part)
            if self.time_ns % TICK_NS == 0:
                self._rub()
            left -= part
            if left <= 0:
                return

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._plant.time_ns

    @property
    def plant(self) -> Plant:
        """The eraser's arm with the whole scene in it."""
        return self._plant

    # -- truth -----------------------------------------------------------------

    @property
    def state(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """q [rad] and dq [rad/s] of the eraser's arm and of the holder's."""
        d = self._plant.data
        return (self._plant.q, self._plant.dq), (
            d.qpos[self._second[0]].copy(),
            d.qvel[self._second[1]].copy(),
        )

    @property
    def T_world_board(self) -> Array:
        """(4, 4) board coordinates (origin in the top left corner, z into the board) in the world, truly [m]."""
        d = self._plant.data
        T = np.eye(4)
        x = d.qpos[self._joint : self._joint + 7]
        R = np.empty(9)
        self._mj.mju_quat2Mat(R, x[3:])
        T[:3, :3] = R.reshape(3, 3)
        T[:3, 3] = x[:3] - T[:3, :3] @ [0.5 * self.ink.size[0], 0.5 * self.ink.size[1], 0.0]
        return T

    def T_base_board(self, arm: int) -> Array:
        """As :attr:`T_world_board`, in the base frame of arm 0 (eraser) or 1 (holder)."""
        T = self.T_world_board
        return T if arm == 0 else self.T_holder_base @ T

    @property
    def T_holder_base(self) -> Array:
        """(4, 4) from the base of the eraser's arm to that of the holder's."""
        T: Array = np.asarray(np.linalg.inv(_holder_base()), dtype=np.float64)
        return T

    @property
    def pad_forces(self) -> Array:
        """(nx, ny) by which the board pushes each pad of the felt along its own normal, truly [N]."""
        return self._contacts()[0]

    @property
    def contact_force(self) -> Array:
        """(3,) of the board on the eraser, world axes, truly [N]."""
        return self._contacts()[1]

    def _contacts(self) -> tuple[Array, Array]:
        d, model = self._plant.data, self._plant.model
        normal, total = np.zeros(len(self._pads)), np.zeros(3)
        wrench = np.empty(6)
        pads = self._pad_of[d.contact.geom]  # (contacts, 2)
        for k in np.flatnonzero((pads >= 0).any(1)) if len(pads) else ():
            self._mj.mj_contactForce(model, d, int(k), wrench)
            # the contact's x axis points from the first geom to the second, on which the force acts
            R = d.contact.frame[k].reshape(3, 3)
            second = bool(pads[k, 1] >= 0)
            total += (1.0 if second else -1.0) * (R.T @ wrench[:3])
            normal[pads[k, int(second)]] += wrench[0]
        return normal.reshape(PADS), total

    def _rub(self) -> None:
        d, mj = self._plant.data, self._mj
        mj.mj_kinematics(self._plant.model, d)
        T = np.linalg.inv(self.T_world_board)
        R = T[:3, :3] @ d.xmat[self._tool].reshape(3, 3)
        face = T[:3, :3] @ d.xpos[self._tool] + T[:3, 3] + R @ [0.0, 0.0, STEM]
        angle = math.atan2(R[1, 0], R[0, 0])
        force = self.pad_forces
        if self._rubbed is not None and force.any():
            before, was = self._rubbed
            turn = math.remainder(angle - was, 2.0 * math.pi)
            cell = self.eraser.width * self.eraser.length / force.size
            self.ink.rub(
                face[:2],
                angle,
                (self.eraser.width, self.eraser.length),
                force / cell,
                face[:2] - before,
                turn,
            )
        self._rubbed = face[:2], angle

    def clearance(
        self, arm: int, q: npt.ArrayLike, q_other: npt.ArrayLike, T_world_board: npt.ArrayLike
    ) -> float:
        """How near an arm would be to table, board, floor and the other arm [m]; at most 0.1, < 0: within them.

        Args:
            arm: 0 the eraser's, 1 the holder's.
            q: (n,) of that arm [rad].
            q_other: (n,) of the other [rad].
            T_world_board: (4, 4) where the board is taken to be.
        """
        mj, model = self._mj, self._plant.model
        if self._mirror is None:
            self._mirror = mj.MjData(model)
        d, far = self._mirror, 0.1
        first, second = (q, q_other) if arm == 0 else (q_other, q)
        d.qpos[: self.arms[0].n], d.qpos[self._second[0]] = first, second
        T = np.asarray(T_world_board, dtype=np.float64)
        d.qpos[self._joint : self._joint + 3] = T[:3, 3] + T[:3, :3] @ [
            0.5 * self.ink.size[0],
            0.5 * self.ink.size[1],
            0.0,
        ]
        d.qpos[self._joint + 3 : self._joint + 7] = _model.quaternion(T[:3, :3])
        mj.mj_kinematics(model, d)
        own, others = self._solids[arm], (*self._solids[1 - arm], *self._solids[2])
        radius, at = model.geom_rbound, d.geom_xpos
        least = far
        for a in own:
            least = min(least, float(at[a, 2]) - 0.08)  # the floor; no link is thicker than that
            for b in others:
                if float(np.linalg.norm(at[a] - at[b])) < radius[a] + radius[b] + least:
                    least = min(least, mj.mj_geomDistance(model, d, int(a), int(b), least, None))
        return least

    def stands(self, T_world_board: npt.ArrayLike) -> bool:
        """A board in this pose (4, 4) would stand on the table with all its feet."""
        R, centre = self._table
        W, H = self.ink.size
        T = np.asarray(T_world_board, dtype=np.float64)
        feet = np.array(
            [
                [0.5 * W + a * x, 0.5 * H + b * y, 0.0]
                for a in (-1, 1)
                for b in (-1, 1)
                for x, y in [self._feet]
            ]
        )
        spots = (feet @ T[:3, :3].T + T[:3, 3] - centre) @ R
        return bool(np.all(np.abs(spots[:, :2]) < np.array(_tabletop(W, H)) - FOOT))

    @property
    def _feet(self) -> tuple[float, float]:
        """From the board's middle to its feet [m]."""
        W, H = self.ink.size
        return 0.85 * (0.5 * W + FRAME), 0.85 * (0.5 * H + FRAME)

    # -- what people and hands do ----------------------------------------------

    def close_grip(self) -> bool:
        """The holder's gripper closes; True if the board's rim is between its fingers and is held from now on.

        The fingers lie along the tool's y axis, so that axis must be the board's normal, within 20 degrees.
        """
        mj, d = self._mj, self._plant.data
        mj.mj_kinematics(self._plant.model, d)
        R = d.xmat[self._hand].reshape(3, 3)
        straight = abs(float(R[:, 1] @ self.T_world_board[:3, 2])) > math.cos(math.radians(20.0))
        if self.grip_distance > GRIP or not straight:
            return False
        eq = self._plant.model.eq_data[self._grip]
        eq[:3] = 0.0
        eq[3:6] = R.T @ (d.xpos[self._board] - d.xpos[self._hand])
        eq[6:10] = _model.quaternion(R.T @ d.xmat[self._board].reshape(3, 3))
        d.eq_active[self._grip] = 1
        return True

    def open_grip(self) -> None:
        """Let the board go."""
        self._plant.data.eq_active[self._grip] = 0

    @property
    def held(self) -> bool:
        """The gripper holds the board."""
        return bool(self._plant.data.eq_active[self._grip])

    @property
    def grip_distance(self) -> float:
        """From the point between the holder's fingers to the nearest point of the board's rim [m]."""
        d = self._plant.data
        T = np.linalg.inv(self.T_world_board)
        at = d.xpos[self._hand] + d.xmat[self._hand].reshape(3, 3) @ [0.0, 0.0, STEM]
        x, y, z = T[:3, :3] @ at + T[:3, 3]
        W, H = self.ink.size
        # to the outline of the frame, as a signed distance to a rectangle
        a, b = abs(x - 0.5 * W) - 0.5 * W - FRAME, abs(y - 0.5 * H) - 0.5 * H - FRAME
        flat = math.hypot(max(a, 0.0), max(b, 0.0)) if max(a, b) > 0.0 else -max(a, b)
        return math.hypot(flat, max(0.0, abs(z - 0.5 * THICK) - 0.5 * THICK))

    def shove(self, force: npt.ArrayLike) -> None:
        """Push the board's middle by a force (3,), world axes [N], from now on; zero ends it.

        Raises:
            InputError: a wrong shape.
        """
        push = np.asarray(force, dtype=np.float64)
        if push.shape != (3,) or not np.all(np.isfinite(push)):
            raise InputError(f"a shove must be a finite force (3,) [N], got {push.shape}")
        self._plant.data.xfrc_applied[self._board, :3] = push

    def push(self, force: npt.ArrayLike) -> None:
        """Push the eraser's arm at its hand by a force (3,), world axes [N], from now on; zero ends it.

        Raises:
            InputError: a wrong shape.
        """
        value = np.asarray(force, dtype=np.float64)
        if value.shape != (3,) or not np.all(np.isfinite(value)):
            raise InputError(f"a push must be a finite force (3,) [N], got {value.shape}")
        d = self._plant.data
        # at the eraser's face, so that it does not turn the tool
        lever = d.xmat[self._tool].reshape(3, 3) @ [0.0, 0.0, STEM]
        d.xfrc_applied[self._tool] = (
            *value,
            *np.cross(lever + d.xpos[self._tool] - d.xipos[self._tool], value),
        )

    def lose_eraser(self) -> None:
        """The felt comes off the hand; nothing of it touches anything from now on."""
        self._plant.model.geom_contype[self._pads] = 0
        self._refresh()

    def find_eraser(self) -> None:
        """It is put back."""
        self._plant.model.geom_contype[self._pads] = 2
        self._refresh()

    def carry_board(self, move: npt.ArrayLike, turn: float = 0.0) -> None:
        """Somebody takes the board and puts it down elsewhere: by `move` (3,) [m] and `turn` [rad] about its normal.

        Raises:
            InputError: a wrong shape.
        """
        way = np.asarray(move, dtype=np.float64)
        if way.shape != (3,) or not np.all(np.isfinite(way)):
            raise InputError(f"a move must be finite and (3,) [m], got {way.shape}")
        d, at = self._plant.data, self._joint
        d.qpos[at : at + 3] += way
        spin = np.empty(4)
        self._mj.mju_mulQuat(
            spin, d.qpos[at + 3 : at + 7], [math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn)]
        )
        d.qpos[at + 3 : at + 7] = spin
        start = self._plant.model.joint("board").dofadr[0]
        d.qvel[start : start + 6] = 0.0
        self.open_grip()

    def _refresh(self) -> None:
        """What MuJoCo asks of a body before it looks at its shapes."""
        model = self._plant.model
        for pad in self._pads:
            model.body_contype[model.geom_bodyid[pad]] = model.geom_contype[pad]

    # -- the camera ------------------------------------------------------------

    @property
    def camera(self) -> Camera:
        """The camera's true calibration; base frame: the eraser's arm."""
        w, h = self.setting.picture
        model = self._plant.model
        k = model.camera("eye").id
        f = 0.5 * h / math.tan(0.5 * math.radians(float(model.cam_fovy[k])))
        K = np.array([[f, 0.0, 0.5 * (w - 1)], [0.0, f, 0.5 * (h - 1)], [0.0, 0.0, 1.0]])
        T = np.eye(4)
        R = np.empty(9)
        self._mj.mju_quat2Mat(R, model.cam_quat[k])
        T[:3, :3] = R.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = model.cam_pos[k]
        return Camera(K, np.zeros(5), (w, h), T)

    def look(self) -> npt.NDArray[np.uint8]:
        """A picture (H, W, 3) BGR with blur, noise and a light that is never quite the same.

        Like any camera's, its exposure keeps what is bright from burning out.

        Raises:
            PalpateError: no OpenGL on this machine.
        """
        s, rng = self.setting, self._rng
        if self._lens is None:
            eye = self._mj.MjvCamera()
            eye.type = self._mj.mjtCamera.mjCAMERA_FIXED
            eye.fixedcamid = self._plant.model.camera("eye").id
            self._lens = _Lens(self._plant.model, *s.picture, eye)
        rgb = self._shown(self._lens)
        gain = np.exp(s.lamps * rng.standard_normal()) * np.exp(0.2 * s.lamps * rng.standard_normal(3))
        light = rgb[..., ::-1].astype(np.float32) * gain.astype(np.float32)
        light *= min(1.0, BRIGHT / max(float(np.percentile(light[::4, ::4].max(2), 99.0)), 1.0))
        if s.blur > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), s.blur)
        if s.noise > 0.0:
            light += s.noise * rng.standard_normal(light.shape, dtype=np.float32)
        return np.clip(np.rint(light), 0, 255).astype(np.uint8)

    def overview(self, width: int = 960, height: int = 540) -> npt.NDArray[np.uint8]:
        """The whole cell from aside (height, width, 3), red green blue, without noise: for people.

        Raises:
            InputError: more pixels than MuJoCo's buffer has.
            PalpateError: no OpenGL on this machine.
        """
        most = _model.OFFSCREEN
        if not (1 <= width <= most[0] and 1 <= height <= most[1]):
            raise InputError(f"a picture must be 1x1 to {most[0]}x{most[1]} pixels, got {width}x{height}")
        if self._aside is not None and self._aside.size != (width, height):
            self._aside.close()
            self._aside = None
        if self._aside is None:
            aside = self._mj.MjvCamera()
            aside.type = self._mj.mjtCamera.mjCAMERA_FREE
            aside.lookat[:] = (0.76, 0.0, 0.36)
            aside.azimuth, aside.elevation, aside.distance = 118.0, -26.0, 1.8
            self._aside = _Lens(self._plant.model, width, height, aside)
        return self._shown(self._aside).copy()

    def _shown(self, lens: _Lens) -> npt.NDArray[np.uint8]:
        self._mj.mj_kinematics(self._plant.model, self._plant.data)
        self._mj.mj_camlight(self._plant.model, self._plant.data)
        return lens.picture(self._plant.data, self._texture, self.ink.rgb)

    def close(self) -> None:
        """Free what pictures took. The scene remains usable."""
        for lens in (self._lens, self._aside):
            if lens is not None:
                lens.close()
        self._lens = self._aside = None
        self._plant.close()

    def _shapes(self, prefix: str) -> list[int]:
        """Geoms of an arm that move with its second joint or a later one, and of what its hand holds."""
        model = self._plant.model
        body = model.body(f"{prefix}{self.arms[0].joints[1].link}").id
        found = []
        for g in range(model.ngeom):
            at = model.geom_bodyid[g]
            if (
                model.body(at).name.startswith("pad:")
                or model.geom_size[g].max() <= 0.0
                or model.geom_rgba[g, 3] == 0.0
            ):
                continue
            while at not in (0, body):
                at = model.body_parentid[at]
            if at == body:
                found.append(g)
        return found

    # -- building --------------------------------------------------------------

    def _build(self, spec: Any) -> None:
        mj, s, (W, H) = self._mj, self.setting, self.ink.size
        # round friction cones: with pyramids, MuJoCo's default, what holds depends on the direction of the push
        spec.option.cone = mj.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        box, sphere = mj.mjtGeom.mjGEOM_BOX, mj.mjtGeom.mjGEOM_SPHERE
        grey, dark = (0.62, 0.64, 0.66, 1.0), (0.25, 0.27, 0.3, 1.0)
        R, centre = self._table
        top = centre + R @ [0.0, 0.0, THICK + 2.0 * FOOT]  # of the table, below the board's middle
        # who meets whom: 1 the arms, 2 the pads, 4 the feet
        spec.worldbody.add_geom(
            name="table",
            type=box,
            size=(*_tabletop(W, H), 0.02),
            pos=top + R @ [0.0, 0.0, 0.02],
            quat=_model.quaternion(R),
            rgba=(0.55, 0.42, 0.3, 1.0),
            contype=0,
            conaffinity=1 | 4,
        )
        board = spec.worldbody.add_body(name="board", pos=centre, quat=_model.quaternion(R))
        board.add_freejoint(name="board")
        outer = np.array([0.5 * W + FRAME, 0.5 * H + FRAME, 0.5 * THICK])
        board.add_geom(
            name="board",
            type=box,
            size=outer,
            pos=(0.0, 0.0, 0.5 * THICK),
            mass=s.mass,
            rgba=grey,
            contype=0,
            conaffinity=1 | 2,
        )
        for a in (-1.0, 1.0):
            for b in (-1.0, 1.0):
                board.add_geom(
                    type=sphere,
                    size=(FOOT, 0.0, 0.0),
                    pos=(a * self._feet[0], b * self._feet[1], THICK + FOOT),
                    mass=0.0,
                    contype=4,
                    conaffinity=0,
                    friction=(s.friction, 0.005, 1e-4),
                    priority=1,
                    rgba=dark,
                )
        self._surface(spec, board)
        self._hands(spec, box)
        self._eye(spec)

    def _surface(self, spec: Any, board: Any) -> None:
        """The writing surface with the ink on it, the frame around it, which nothing touches, and magnets."""
        mj, (W, H) = self._mj, self.ink.size
        rows, columns = self.ink.amount.shape
        spec.add_texture(
            name="ink",
            type=mj.mjtTexture.mjTEXTURE_2D,
            width=columns,
            height=rows,
            builtin=mj.mjtBuiltin.mjBUILTIN_FLAT,  # the ink comes with each picture
        )
        material = spec.add_material(name="ink", specular=0.2, shininess=0.6, rgba=(*(3 * (WHITE,)), 1.0))
        textures = list(material.textures)
        textures[mj.mjtTextureRole.mjTEXROLE_RGB] = "ink"
        material.textures = textures
        w, h = 0.5 * W, 0.5 * H
        spec.add_mesh(
            name="surface",
            uservert=[-w, -h, 0, w, -h, 0, w, h, 0, -w, h, 0],
            userface=[0, 2, 1, 0, 3, 2],
            usertexcoord=[0, 0, 1, 0, 1, 1, 0, 1],
            inertia=mj.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        board.add_geom(
            type=mj.mjtGeom.mjGEOM_MESH,
            meshname="surface",
            material="ink",
            pos=(0.0, 0.0, -5e-4),
            mass=0.0,
            contype=0,
            conaffinity=0,
        )
        for x, y, a, b in (
            (0.0, -h - 0.5 * FRAME, w + FRAME, 0.5 * FRAME),
            (0.0, h + 0.5 * FRAME, w + FRAME, 0.5 * FRAME),
            (-w - 0.5 * FRAME, 0.0, 0.5 * FRAME, h),
            (w + 0.5 * FRAME, 0.0, 0.5 * FRAME, h),
        ):
            board.add_geom(
                type=mj.mjtGeom.mjGEOM_BOX,
                size=(a, b, 0.5 * THICK + 5e-4),
                pos=(x, y, 0.5 * THICK - 5e-4),
                mass=0.0,
                rgba=(0.36, 0.38, 0.41, 1.0),
                contype=0,
                conaffinity=0,
            )

        for x, y in self.setting.magnets:
            board.add_geom(
                type=mj.mjtGeom.mjGEOM_CYLINDER,
                size=(MAGNET[0], 0.5 * MAGNET[1], 0.0),
                pos=(x - w, y - h, -0.5 * MAGNET[1]),
                mass=0.01,
                rgba=(0.75, 0.12, 0.1, 1.0),
                contype=0,
                conaffinity=1 | 2,
            )

    def _hands(self, spec: Any, box: Any) -> None:
        mj, e = self._mj, self.eraser
        ghost = {"contype": 0, "conaffinity": 0}
        flange = spec.body("arm:payload").parent
        tip = self.arms[0].T_last_tip
        hold = flange.add_body(name="eraser", pos=tip[:3, 3], quat=_model.quaternion(tip[:3, :3]))
        half = np.array([0.5 * e.width, 0.5 * e.length, 0.5 * STEM])
        hold.mass, hold.ipos = BLOCK, (0.0, 0.0, 0.5 * STEM)
        hold.inertia = (
            BLOCK
            / 3.0
            * np.array(
                [half[1] ** 2 + half[2] ** 2, half[0] ** 2 + half[2] ** 2, half[0] ** 2 + half[1] ** 2]
            )
        )
        hold.explicitinertial = True
        felt = (0.5 * e.width, 0.5 * e.length, 0.012)
        hold.add_geom(
            type=box, size=felt, pos=(0, 0, STEM - 0.014), rgba=(0.16, 0.3, 0.5, 1.0), mass=0, **ghost
        )
        hold.add_geom(
            type=box,
            size=(0.02, 0.02, 0.5 * STEM - 0.013),
            pos=(0, 0, 0.5 * STEM - 0.013),
            rgba=(0.3, 0.3, 0.32, 1),
            mass=0,
            **ghost,
        )
        stiffness = STIFFNESS / (PADS[0] * PADS[1])
        for k, (x, y) in enumerate(zip(*_grid(e), strict=True)):
            pad = hold.add_body(name=f"pad:{k}", pos=(x, y, STEM - PAD))
            slide = pad.add_joint(name=f"pad:{k}", type=mj.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1))
            slide.stiffness[0] = stiffness
            slide.damping[0] = 2.0 * math.sqrt(stiffness * PAD)
            slide.limited = mj.mjtLimited.mjLIMITED_TRUE
            slide.range = (-TRAVEL, 0.5 * TRAVEL)
            pad.add_geom(
                name=f"pad:{k}",
                type=mj.mjtGeom.mjGEOM_SPHERE,
                size=(PAD, 0.0, 0.0),
                mass=PAD,
                contype=2,
                conaffinity=0,
                priority=1,
                friction=(self.setting.felt_friction, 0.005, 1e-4),
                rgba=(0.85, 0.85, 0.8, 1.0),
            )
        base = _holder_base()
        self._other = _model.add_arm(
            spec,
            self.arms[1],
            "holder:",
            _model.quaternion(base[:3, :3]),
            pos=HOLDER,
            limits=True,
            contacts=True,
        )
        for side in (-1.0, 1.0):
            self._other.payload.add_geom(
                type=box,
                size=(0.012, 0.003, 0.5 * STEM),
                pos=(0.0, side * (0.5 * THICK + 0.0035), 0.5 * STEM),
                rgba=(0.3, 0.3, 0.32, 1.0),
                mass=0,
                **ghost,
            )
        grip = spec.add_equality(
            name="grip",
            type=mj.mjtEq.mjEQ_WELD,
            objtype=mj.mjtObj.mjOBJ_BODY,
            name1="holder:payload",
            name2="board",
            active=False,
        )
        grip.data[10] = 1.0
        grip.solref = (0.01, 1.0)

    def _eye(self, spec: Any) -> None:
        """The camera looks at the board's middle from the side, above the arms' reach."""
        at = np.array([self.setting.centre[0], -0.75, 1.15])
        z = at - self.setting.centre
        z /= np.linalg.norm(z)
        x = np.cross([1.0, 0.0, 0.0], z)  # the picture's up is away from the eraser's arm
        x /= np.linalg.norm(x)
        R = np.stack((x, np.cross(z, x), z), axis=1)
        spec.worldbody.add_camera(name="eye", pos=at, quat=_model.quaternion(R), fovy=42.0)


class _Lens:
    """One OpenGL context for one camera, in which a texture is replaced before each picture."""

    def __init__(self, model: Any, width: int, height: int, view: Any) -> None:
        self._mj = mj = _model.mujoco()
        self.size = width, height
        self._model, self._rect = model, mj.MjrRect(0, 0, width, height)
        try:
            self._gl = mj.GLContext(width, height)
            self._gl.make_current()
            self._context = mj.MjrContext(model, mj.mjtFontScale.mjFONTSCALE_100.value)
        except (ImportError, AttributeError, RuntimeError, OSError, TypeError, mj.FatalError) as error:
            raise PalpateError(
                f"pictures of the board need OpenGL, which MuJoCo could not start: {error}"
            ) from error
        mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mj.MjvScene(model, maxgeom=2000)
        self._option = mj.MjvOption()
        self._view = view

    def picture(self, data: Any, texture: int, face: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        mj, model = self._mj, self._model
        self._gl.make_current()
        at = model.tex_adr[texture]
        model.tex_data[at : at + face.size] = face.ravel()
        mj.mjr_uploadTexture(model, self._context, texture)
        mj.mjv_updateScene(
            model, data, self._option, None, self._view, mj.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mj.mjr_render(self._rect, self._scene, self._context)
        rgb = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mj.mjr_readPixels(rgb, None, self._rect, self._context)
        return rgb[::-1]  # OpenGL's first row is the lowest

    def close(self) -> None:
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def _table(s: Setting) -> tuple[Array, Array]:
    """R_world_board and the place of the writing surface's middle."""
    c, k = math.cos(s.turn), math.sin(s.turn)
    # x to the right as seen from the eraser's arm, y towards it, z down; the tilt lifts what is far
    flat = np.array([[c, -k, 0.0], [k, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    )
    c, k = math.cos(s.tilt), math.sin(s.tilt)
    R = np.array([[c, 0.0, -k], [0.0, 1.0, 0.0], [k, 0.0, c]]) @ flat
    return R, np.array(s.centre, dtype=np.float64)


def _tabletop(width: float, height: float) -> tuple[float, float]:
    """Half its sides under a board of this size [m]."""
    return 0.55 * width + 0.1, 0.55 * height + 0.1


def _holder_base() -> Array:
    T = np.diag([-1.0, -1.0, 1.0, 1.0])
    T[:3, 3] = HOLDER
    return T


def _grid(eraser: Eraser) -> tuple[Array, Array]:
    """x and y of the pads on the tool [m], in the order of (nx, ny)."""
    x = (np.arange(PADS[0]) + 0.5) / PADS[0] - 0.5
    y = (np.arange(PADS[1]) + 0.5) / PADS[1] - 0.5
    a, b = np.meshgrid(x * eraser.width, y * eraser.length, indexing="ij")
    return a.ravel(), b.ravel()


def _fitted(arm: Arm, eraser: Eraser) -> Arm:
    """The arm with the eraser as part of its last link."""
    w, h = eraser.width, eraser.length
    box = BLOCK / 12.0 * np.diag([h * h + STEM**2, w * w + STEM**2, w * w + h * h])
    pieces = [(BLOCK, np.array([0.0, 0.0, 0.5 * STEM]), box)]
    tip = 0.4 * PAD * PAD**2 * np.eye(3)  # a uniform ball
    pieces += [(PAD, np.array([x, y, STEM - PAD]), tip) for x, y in zip(*_grid(eraser), strict=True)]
    last, T = arm.joints[-1], arm.T_last_tip
    R = T[:3, :3]
    bodies = [(last.mass, last.com, last.inertia)]
    bodies += [(m, R @ c + T[:3, 3], R @ inertia @ R.T) for m, c, inertia in pieces]
    mass = sum(m for m, _, _ in bodies)
    com = sum((m * c for m, c, _ in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for m, c, about in bodies:
        r = c - com
        inertia += about + m * (r @ r * np.eye(3) - np.outer(r, r))
    return arm.replace(joints=(*arm.joints[:-1], last.replace(mass=mass, com=com, inertia=inertia)))
