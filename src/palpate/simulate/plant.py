"""The simulated robot: rigid-body truth in MuJoCo, from an Arm, with loads and pushes that come and go."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array, inertia_complaint
from ..errors import InputError
from . import _model
from ._render import Camera, Studio

Integrator: TypeAlias = Literal["extrapolated", "rk4", "discrete", "implicitfast", "implicit", "euler"]

# integrator: longest step [s] by default; higher orders take longer ones for the same error
_STEPS: dict[str, float] = {
    "extrapolated": 1e-3,
    "rk4": 1e-3,
    "discrete": 2.5e-4,
    "implicitfast": 2.5e-4,
    "implicit": 2.5e-4,
    "euler": 2.5e-4,
}


@dataclass(frozen=True, slots=True, eq=False)
class Load:
    """An object that can be held. The point is the arm's grasp point, the axes are those of the tip frame."""

    mass: float
    """[kg], > 0"""
    com: npt.ArrayLike = (0.0, 0.0, 0.0)
    """(3,) centre of mass, from the grasp point, tip axes [m]"""
    inertia: npt.ArrayLike | None = None
    """(3, 3) about the centre of mass, tip axes [kg m^2]; None: a point mass"""
    size: tuple[float, float, float] | None = None
    """lengths of the box it is drawn as, tip axes [m]; None: a cube of 2000 kg/m^3"""

    def __post_init__(self) -> None:
        put = object.__setattr__
        mass = _number(self.mass, "mass of a load")
        if mass <= 0.0:
            raise InputError(f"mass of a load must be > 0 kg, got {mass!r}; to let go, release the load")
        put(self, "mass", mass)
        put(self, "com", _numbers(self.com, (3,), "centre of mass of a load"))
        inertia = _numbers(
            np.zeros((3, 3)) if self.inertia is None else self.inertia, (3, 3), "inertia of a load"
        )
        complaint = inertia_complaint(inertia, definite=False)
        if np.any(inertia != inertia.T):
            complaint = "inertia is not symmetric"
        if complaint:
            raise InputError(f"load of {mass:g} kg: {complaint}")
        put(self, "inertia", inertia)
        if self.size is not None:
            size = _numbers(self.size, (3,), "size of a load")
            if np.any(size <= 0.0):
                raise InputError(f"size of a load must be > 0 m, got {size.tolist()}")
            put(self, "size", tuple(size.tolist()))

    @classmethod
    def box(cls, mass: float, size: tuple[float, float, float], com: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Load:
        """A uniform box of `mass` [kg], edges `size` [m] along the tip's axes, centre at `com` (3,) [m]."""
        x, y, z = (s * s for s in _numbers(size, (3,), "size of a load").tolist())
        return cls(mass, com, mass / 12.0 * np.diag([y + z, x + z, x + y]), size)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What really happens at one instant: M q'' + C q' + g + tau_f = tau + tau_ext. Arrays are copies."""

    time_ns: int
    q: Array
    """(n,) [rad]"""
    dq: Array
    """(n,) [rad/s]"""
    ddq: Array
    """(n,) [rad/s^2] under the torque of the period that just ended"""
    torque: Array
    """(n,) tau, link-side motor torque of the period that just ended [N m]"""
    friction: Array
    """(n,) tau_f, > 0 where it opposes positive motion [N m]"""
    external: Array
    """(n,) tau_ext of held object, pushes, contacts, end stops; > 0 when they push the joint forward [N m]"""
    payload_mass: float
    """[kg]; 0 when nothing is held"""
    payload_wrench: Array
    """(6,) force [N], then torque about the grasp point [N m], by which weight and inertia of the held object
    act on the arm; base axes"""
    T_base_tip: Array
    """(4, 4) [m]"""


class Plant:
    """A simulated arm in torque control: :meth:`step` with a torque, read q and dq, ask :meth:`truth` for more.

    Viscous friction is joint damping, rotor inertia is armature, Coulomb friction is MuJoCo's dry-friction
    constraint: it truly sticks, unlike the smooth sign of the arm's friction model. A Stribeck peak and
    load-dependent friction move that constraint's bound before every integration step; the load is the motor
    torque less the friction. Torque acts on the joints directly, unlimited: limits and quantisation belong to
    the drives (SensorModel, MujocoDriver).

    Args:
        arm: the arm. Its base is fixed in the world, its gravity vector acts as given.
        timestep: longest integration step [s]; None: 1 ms for "extrapolated" and "rk4", 0.25 ms for the
            others. The duration given to :meth:`step` is divided evenly.
        integrator: "extrapolated" goes through every :meth:`step` twice with MuJoCo's implicit "discrete"
            method, with whole and with half steps, and extrapolates to step zero (Richardson; second order,
            stable for any damping). "rk4" is of fourth order and blows up where damping/inertia times the
            step exceeds 2.8. "discrete", "implicitfast", "implicit" and "euler" are MuJoCo's methods of first
            order. None: "extrapolated", or "discrete" if there are contacts or the scene has joints of its
            own, where extrapolation has no meaning.
        limits: end stops at the joints' position limits.
        contacts: the arm's shapes and the held object collide with what `scene` adds, not with each other.
        scene: called once with the mujoco.MjSpec before it is compiled, to add tables, lights, cameras.

    Raises:
        ArmError: the arm has no masses.
        InputError: an option is not one of the choices.
        MissingExtraError: mujoco is not installed.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        timestep: float | None = None,
        integrator: Integrator | None = None,
        limits: bool = False,
        contacts: bool = False,
        scene: Callable[[Any], None] | None = None,
    ) -> None:
        if integrator is not None and integrator not in _STEPS:
            raise InputError(f"integrator must be one of {', '.join(_STEPS)}, got {integrator!r}")
        if timestep is not None and not 1e-7 <= _number(timestep, "timestep") <= 0.1:
            raise InputError(f"timestep must be between 1e-7 and 0.1 s, got {timestep!r}")
        self._mj = _model.mujoco()
        self._arm = arm
        self._built = _model.build(arm, limits=limits, contacts=contacts, scene=scene)
        n, model = arm.n, self._built.model
        self._model = model
        self._data = self._mj.MjData(model)
        # truth is computed here, so that looking never changes what happens next
        self._mirror = self._mj.MjData(model)
        self._mj.mj_setConst(model, self._mirror)
        self._q, self._dq = self._data.qpos[:n], self._data.qvel[:n]
        self._applied = self._data.qfrc_applied[:n]
        self._torque = np.zeros(n)

        friction = [j.friction for j in arm.joints]
        self._offset = np.array([f.offset for f in friction])
        self._coulomb = np.array([f.coulomb for f in friction])
        self._peak = np.array([0.0 if f.static is None else f.static - f.coulomb for f in friction])
        self._stribeck = np.array([f.stribeck_velocity or math.inf for f in friction])
        self._load_friction = np.array([f.load for f in friction])
        # the bound moves with speed or load: MuJoCo's own loop would hold it for a whole control period
        self._moving_friction = bool(np.any(self._peak) or np.any(self._load_friction))
        # a bound of zero would take the joint's row out of the constraints
        self._least = 1e-12 * ((self._coulomb > 0.0) | (self._peak > 0.0) | (self._load_friction > 0.0))
        self._dry = int(self._mj.mjtConstraint.mjCNSTR_FRICTION_DOF)

        smooth = not contacts and model.nv == n
        if integrator == "extrapolated" and not smooth:
            raise InputError(
                'integrator "extrapolated" cannot go through contacts or a scene with joints: take "discrete"'
            )
        self._integrator: Integrator = integrator or ("extrapolated" if smooth else "discrete")
        self._timestep = float(timestep or _STEPS[self._integrator])
        method = "discrete" if self._integrator == "extrapolated" else self._integrator
        self._method = getattr(self._mj.mjtIntegrator, f"mjINT_{method.upper()}")
        self._options = model.opt
        self._options.integrator = self._method
        self._h = 0.0
        self._warm = self._data.qacc_warmstart[:n]
        # extrapolation: state at the start, and after the pass with whole steps
        self._start, self._coarse = np.empty((3, n)), np.empty((2, n))

        self._studio: Studio | None = None
        self._load: Load | None = None
        self._time_ns = 0
        self.reset()

    @property
    def arm(self) -> Arm:
        """The arm that is simulated."""
        return self._arm

    @property
    def integrator(self) -> Integrator:
        """The integrator in use."""
        return self._integrator

    @property
    def timestep(self) -> float:
        """Longest integration step [s]."""
        return self._timestep

    @property
    def model(self) -> Any:
        """The mujoco.MjModel, for what this class does not offer; joint i of the arm is qpos[i], qvel[i]."""
        return self._model

    @property
    def data(self) -> Any:
        """The mujoco.MjData that is integrated; derived quantities in it lag by one integration step."""
        return self._data

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._time_ns

    @property
    def q(self) -> Array:
        """(n,) joint positions, a copy [rad]."""
        return self._q.copy()

    @property
    def dq(self) -> Array:
        """(n,) joint velocities, a copy [rad/s]."""
        return self._dq.copy()

    @property
    def torque(self) -> Array:
        """(n,) motor torque of the last step, a copy [N m]; zero after a reset."""
        return self._torque.copy()

    @property
    def load(self) -> Load | None:
        """What is held now."""
        return self._load

    def reset(
        self, q: npt.ArrayLike | None = None, dq: npt.ArrayLike | None = None, *, time_ns: int = 0
    ) -> None:
        """Start again from q [rad] and dq [rad/s], both (n,), default zero, at `time_ns` [ns].

        Nothing is held, nothing pushes, there is no torque.

        Raises:
            InputError: a value has the wrong shape or is not finite.
        """
        n = self._arm.n
        q = np.zeros(n) if q is None else _numbers(q, (n,), "q")
        dq = np.zeros(n) if dq is None else _numbers(dq, (n,), "dq")
        self.release()
        self._mj.mj_resetData(self._model, self._data)
        self._q[:], self._dq[:] = q, dq
        self._applied[:] = -self._offset
        self._torque[:] = 0.0
        self._time_ns = int(time_ns)

    def step(self, torque: npt.ArrayLike, duration_ns: int) -> None:
        """Hold a torque for a while.

        Args:
            torque: (n,) link-side motor torque [N m].
            duration_ns: how long [ns], > 0; divided into equal steps no longer than `timestep`.

        Raises:
            InputError: wrong shape or a number that is not finite, or the simulation left the finite numbers.
        """
        if duration_ns <= 0:
            raise InputError(f"duration_ns must be > 0, got {duration_ns!r}")
        tau = self._torque
        # the usual argument is checked in place, anything else is converted
        ready = isinstance(torque, np.ndarray) and torque.dtype == tau.dtype and torque.shape == tau.shape
        tau[:] = torque if ready and np.isfinite(torque).all() else _numbers(torque, tau.shape, "torque")
        np.subtract(tau, self._offset, out=self._applied)
        duration = duration_ns * 1e-9
        count = max(1, math.ceil(duration / self._timestep - 1e-6))
        h = duration / count
        if self._integrator == "extrapolated":
            q, dq, start, coarse = self._q, self._dq, self._start, self._coarse
            start[0], start[1], start[2] = q, dq, self._warm
            self._advance(tau, count, h)
            coarse[0], coarse[1] = q, dq
            q[:], dq[:], self._warm[:] = start
            self._advance(tau, 2 * count, 0.5 * h)
            self._check(duration_ns, 0.5 * h)
            # both passes are of first order: twice the finer less the coarser cancels that error
            q += q
            q -= coarse[0]
            dq += dq
            dq -= coarse[1]
        else:
            self._advance(tau, count, h)
        self._time_ns += int(duration_ns)
        self._data.time = self._time_ns * 1e-9
        self._check(0, h)

    def _check(self, ahead_ns: int, h: float) -> None:
        """Raise InputError if the state, `ahead_ns` later than the clock shows, is beyond all reason."""
        if not float(self._q @ self._q) + float(self._dq @ self._dq) < 1e18:
            raise InputError(
                f"the simulation of {self._arm.name!r} diverged before "
                f"{(self._time_ns + ahead_ns) * 1e-9:.6g} s ({self._integrator}, steps of {h:g} s): "
                "take a smaller timestep or gentler torques"
            )

    def _advance(self, tau: Array, count: int, h: float) -> None:
        """Take `count` integration steps of `h` [s] under the motor torque `tau` (n,) [N m]."""
        if h != self._h:
            self._options.timestep = self._h = h
        if not self._moving_friction:
            self._mj.mj_step(self._model, self._data, count)
            return
        for _ in range(count):
            self._bound_friction(self._data, tau)
            self._mj.mj_step(self._model, self._data)

    def _bound_friction(self, data: Any, tau: Array) -> None:
        """Set the dry-friction bounds [N m] for the state and load of the last evaluated step."""
        n = self._arm.n
        bound = self._peak * np.exp(-np.square(data.qvel[:n] / self._stribeck))
        bound += self._coulomb
        if self._load_friction.any():
            # what the gear carries: motor torque less the friction of the step before
            bound += self._load_friction * np.abs(tau - self._friction(data))
        self._model.dof_frictionloss[:n] = np.maximum(bound, self._least)

    def _friction(self, data: Any) -> Array:
        """(n,) tau_f [N m] of the last evaluated step."""
        n = self._arm.n
        friction = self._offset - data.qfrc_damper[:n]
        rows = np.flatnonzero(data.efc_type == self._dry)
        friction[data.efc_id[rows]] -= data.efc_force[rows]
        return friction

    def attach(self, load: Load | float) -> None:
        """Hold an object rigidly from now on; a number is a point mass [kg] at the grasp point.

        The arm's velocity does not jump: the object is taken at the hand's own speed. Replaces what was held.
        """
        if not isinstance(load, Load):
            load = Load(load)
        self._load = load
        self._write_load(load.mass, np.asarray(load.com), np.asarray(load.inertia))
        geom, model = self._built.payload_geom, self._model
        model.geom_pos[geom] = model.body_ipos[self._built.payload]
        model.geom_size[geom] = _model.box_halves(load.mass, load.size)
        model.geom_rbound[geom] = float(np.linalg.norm(model.geom_size[geom]))
        model.geom_aabb[geom] = (
            0.0,
            0.0,
            0.0,
            *model.geom_size[geom],
        )  # contacts outside of it are not looked for
        model.geom_rgba[geom] = _model.PAYLOAD_COLOUR

    def release(self) -> None:
        """Let go: object and momentum are gone, the arm's velocity does not jump. Nothing held: no effect."""
        if self._load is None:
            return
        self._load = None
        self._write_load(0.0, np.zeros(3), np.zeros((3, 3)))
        self._model.geom_rgba[self._built.payload_geom] = _model.HIDDEN_COLOUR

    def _write_load(self, mass: float, com: Array, inertia: Array) -> None:
        _model.write_inertial(self._model, self._built.payload, mass, self._arm.grasp + com, inertia)
        self._mj.mj_setConst(self._model, self._mirror)

    def push(
        self,
        frame: str | int,
        force: npt.ArrayLike = (0.0, 0.0, 0.0),
        torque: npt.ArrayLike = (0.0, 0.0, 0.0),
        *,
        point: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Push on a link from now on, until :meth:`stop_pushing`; a new push on the same link replaces the old.

        Args:
            frame: name of a link, of the tip or of a fixed frame of the arm, "grasp", or the index of a link.
            force: (3,) [N], base axes, constant while the link moves.
            torque: (3,) [N m], base axes.
            point: (3,) where the force acts, in `frame`; it moves with the link [m].

        Raises:
            InputError: no such frame, or a value of the wrong shape.
        """
        link, T = self._frame(frame)
        if link < 0:
            raise InputError(f"push: frame {frame!r} is on the base, which does not move")
        where = T[:3, :3] @ _numbers(point, (3,), "point") + T[:3, 3]
        wrench = np.stack((_numbers(force, (3,), "force"), _numbers(torque, (3,), "torque")))
        hand = self._built.hands[link]
        # the hand has no mass, so its place may change without mj_setConst
        self._model.body_pos[hand] = where
        self._data.xfrc_applied[hand] = (wrench @ self._built.R_world_base.T).ravel()

    def stop_pushing(self, frame: str | int | None = None) -> None:
        """End the push on the link of `frame`; None: every push."""
        if frame is None:
            self._data.xfrc_applied[list(self._built.hands)] = 0.0
            return
        link, _ = self._frame(frame)
        if link >= 0:
            self._data.xfrc_applied[self._built.hands[link]] = 0.0

    def _frame(self, frame: str | int) -> tuple[int, Array]:
        """Link index (-1: base) and T_link_frame (4, 4) of a frame given by name or link index."""
        arm = self._arm
        if isinstance(frame, str):
            links = [j.link for j in arm.joints]
            if frame in links:
                return links.index(frame), np.eye(4)
            if frame == arm.tip:
                return arm.n - 1, arm.T_last_tip
            if frame in arm.frames:
                return arm.frames[frame]
            if frame == "grasp":
                T = arm.T_last_tip.copy()
                T[:3, 3] += T[:3, :3] @ arm.grasp
                return arm.n - 1, T
            if frame == arm.base:
                return -1, np.eye(4)
            names = dict.fromkeys([*links, arm.tip, "grasp", *arm.frames])
            raise InputError(f"no frame {frame!r} in arm {arm.name!r}; there are {', '.join(names)}")
        if not 0 <= frame < arm.n:
            raise InputError(f"link index must be 0 to {arm.n - 1}, got {frame!r}")
        return int(frame), np.eye(4)

    def pose(self, frame: str | int | None = None) -> Array:
        """T_base_frame (4, 4) [m] now, of a frame named as in :meth:`push`; None: the tip."""
        link, T = self._frame(self._arm.tip if frame is None else frame)
        self._look()
        return self._pose(link, T)

    def _look(self) -> None:
        """Evaluate the present state in the mirror: derived quantities there are those of now."""
        mj, m, d = self._mj, self._mirror, self._data
        mj.mj_copyState(self._model, d, m, int(mj.mjtState.mjSTATE_INTEGRATION))
        if self._moving_friction:
            self._bound_friction(d, self._torque)
        # the discrete method calls "acceleration" what a whole step does on average; truth is of an instant
        self._options.integrator = mj.mjtIntegrator.mjINT_IMPLICITFAST
        mj.mj_forward(self._model, m)
        self._options.integrator = self._method

    def _pose(self, link: int, T_link_frame: Array) -> Array:
        m, body, R = self._mirror, self._built.links[link + 1], self._built.R_world_base.T
        T = np.eye(4)
        T[:3, :3] = R @ m.xmat[body].reshape(3, 3)
        T[:3, 3] = R @ m.xpos[body]
        return T @ T_link_frame

    def truth(self) -> Truth:
        """Everything true at this instant. Looking does not change the simulation."""
        mj, m, built, arm = self._mj, self._mirror, self._built, self._arm
        self._look()
        n, body = arm.n, built.payload
        friction = self._friction(m)
        external = np.zeros(n)
        # constraints that are not dry friction: contacts and end stops
        rows = np.flatnonzero(m.efc_type != self._dry)
        if rows.size:
            external += m.efc_force[rows] @ m.efc_J.reshape(-1, self._model.nv)[rows, :n]
        jac = np.zeros((6, self._model.nv))
        for hand in built.hands:
            wrench = m.xfrc_applied[hand]
            if wrench.any():
                mj.mj_jac(self._model, m, jac[:3], jac[3:], m.xpos[hand], hand)
                external += wrench @ jac[:, :n]
        payload_wrench = np.zeros(6)
        mass = 0.0 if self._load is None else self._load.mass
        if mass > 0.0:
            # MuJoCo's acceleration has gravity in it: what an accelerometer in the object would feel
            mj.mj_rnePostConstraint(self._model, m)
            acceleration = np.empty(6)
            mj.mj_objectAcceleration(self._model, m, mj.mjtObj.mjOBJ_BODY, body, acceleration, 0)
            velocity = np.empty(6)
            mj.mj_objectVelocity(self._model, m, mj.mjtObj.mjOBJ_BODY, body, velocity, 0)
            R = m.ximat[body].reshape(3, 3)
            inertia = R @ np.diag(self._model.body_inertia[body]) @ R.T
            omega = velocity[:3]
            force = -mass * acceleration[3:]
            torque = -(inertia @ acceleration[:3] + np.cross(omega, inertia @ omega))
            point = m.xpos[body] + m.xmat[body].reshape(3, 3) @ arm.grasp
            torque += np.cross(m.xipos[body] - point, force)
            mj.mj_jac(self._model, m, jac[:3], jac[3:], point, body)
            external += np.concatenate((force, torque)) @ jac[:, :n]
            payload_wrench[:3], payload_wrench[3:] = (
                built.R_world_base.T @ force,
                built.R_world_base.T @ torque,
            )
        return Truth(
            time_ns=self._time_ns,
            q=self.q,
            dq=self.dq,
            ddq=m.qacc[:n].copy(),
            torque=self.torque,
            friction=friction,
            external=external,
            payload_mass=mass,
            payload_wrench=payload_wrench,
            T_base_tip=self._pose(n - 1, arm.T_last_tip),
        )

    def energy(self) -> float:
        """Kinetic plus potential energy of arm, rotors and held object [J]; zero height is the base."""
        self._look()
        self._mj.mj_energyPos(self._model, self._mirror)
        self._mj.mj_energyVel(self._model, self._mirror)
        return float(self._mirror.energy.sum())

    def render(
        self, width: int = 960, height: int = 720, *, camera: Camera | str | None = None
    ) -> npt.NDArray[np.uint8]:
        """A picture of the present state, (height, width, 3) uint8.

        Args:
            width: [pixel], at most 2560.
            height: [pixel], at most 1600.
            camera: where to look from; a text names a camera of the scene; None: the whole arm.

        Raises:
            InputError: the size is out of range, or there is no such camera.
            PalpateError: no OpenGL on this machine.
        """
        if self._studio is None or self._studio.size != (width, height):
            self.close()
            self._studio = Studio(self._model, width, height)
        self._look()
        return self._studio.picture(
            self._mirror, camera or Camera(), self._built.R_world_base, self._built.extent
        )

    def close(self) -> None:
        """Free what rendering took. The plant remains usable."""
        if self._studio is not None:
            self._studio.close()
            self._studio = None


def _number(value: object, what: str) -> float:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise InputError(f"{what} must be finite, got {number!r}")
    return number


def _numbers(value: object, shape: tuple[int, ...], what: str) -> Array:
    """A finite read-only float64 copy of the stated shape, else InputError naming it."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be numbers of shape {shape}, got {value!r:.80}") from None
    if array.shape != shape:
        raise InputError(f"{what} must have shape {shape}, got {array.shape}")
    if not np.all(np.isfinite(array)):
        raise InputError(f"{what} must be finite, got {array.tolist()}")
    array.setflags(write=False)
    return array
