"""The arm: kinematics, inertias, gravity, friction, drives and sensing of a serial chain, immutable.

SI units. Joint i moves link i; the frame of link i is the frame of joint i, which at q = 0 sits at
``T_parent_joint`` in the frame of link i-1 (in the base frame for the first joint). ``T_a_b`` maps
coordinates in b to coordinates in a.
Sign: M(q) q'' + C(q,q') q' + g(q) + tau_f(q') = tau + tau_ext, tau_ext > 0 when the environment pushes the robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from .errors import ArmError

if TYPE_CHECKING:
    from os import PathLike

    from ._core import Arm as CoreArm

Array: TypeAlias = npt.NDArray[np.float64]

MAX_JOINTS = 16
"""Longest chain the core holds."""

_LINK_COLOUR = (0.86, 0.87, 0.89, 1.0)
_JOINT_COLOUR = (0.20, 0.45, 0.72, 1.0)

HUGE = 1e9
"""No length, mass, inertia or torque of an arm comes near; larger ones are errors and overflow later."""


def _number(value: object, what: str, *, low: float = -HUGE, above: float | None = None) -> float:
    """A finite float >= low (and > above), else ArmError naming it."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ArmError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number) or abs(number) > HUGE:
        raise ArmError(f"{what} must be finite and below {HUGE:g}, got {number!r}")
    if number < low:
        raise ArmError(f"{what} must be >= {low:g}, got {number!r}")
    if above is not None and number <= above:
        raise ArmError(f"{what} must be > {above:g}, got {number!r}")
    return number


def _array(value: object, shape: tuple[int, ...], what: str) -> Array:
    """A read-only finite float64 copy of the stated shape, else ArmError naming it."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ArmError(f"{what} must be numbers of shape {shape}, got {value!r:.80}") from None
    if array.shape != shape:
        raise ArmError(f"{what} must have shape {shape}, got {array.shape}")
    if not np.all(np.abs(array) <= HUGE):
        raise ArmError(f"{what} must be finite and below {HUGE:g}, got {array.tolist()}")
    array.setflags(write=False)
    return array


def _placement(value: object, what: str) -> Array:
    """A read-only 4x4 rigid transform, else ArmError naming it."""
    T = _array(value, (4, 4), what)
    if np.any(T[3] != (0.0, 0.0, 0.0, 1.0)):
        raise ArmError(f"{what}: the last row must be 0 0 0 1, got {T[3].tolist()}")
    R = T[:3, :3]
    error = float(np.max(np.abs(R.T @ R - np.eye(3))))
    if error > 1e-6 or np.linalg.det(R) < 0.0:
        raise ArmError(f"{what}: the upper left 3x3 block must be a rotation, R'R - 1 is up to {error:.3g}")
    if error > 1e-12:  # printed with few digits: take the nearest rotation, so that chains stay rigid
        u, _, vt = np.linalg.svd(R)
        T = T.copy()
        T[:3, :3] = u @ vt
        T.setflags(write=False)
    return T


class _Record:
    """What frozen dataclasses with arrays lack: exact equality, a hash, arrays read-only after unpickling."""

    __slots__ = ()

    def _values(self) -> tuple[Any, ...]:
        return tuple(getattr(self, f.name) for f in fields(self) if f.init)  # type: ignore[arg-type]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        assert isinstance(other, _Record)
        return all(_same(a, b) for a, b in zip(self._values(), other._values(), strict=True))

    def __hash__(self) -> int:
        return hash((type(self), *(v for v in self._values() if isinstance(v, str | float | int))))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in self._values())


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and bool(np.all(a == b))
    if isinstance(a, Mapping):
        return isinstance(b, Mapping) and a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(_same, a, b))
    return bool(a == b)


def smallest_turn(z: Array) -> Array:
    """(3, 3): the smallest rotation that takes the z axis to a unit vector (3,)."""
    v, c = np.cross([0.0, 0.0, 1.0], z), float(z[2])
    if c <= -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    R: Array = np.eye(3) + K + K @ K / (1.0 + c)
    return R


@dataclass(frozen=True, slots=True)
class Friction:
    """Joint friction, link side, as torque that must be overcome (MATH.md section 6).

    tau_f = (F_c + (F_s - F_c) exp(-(dq/v_s)^2)) s(dq) + F_v dq + F_o with F_c = coulomb + load abs(tau_load) and
    s(dq) = tanh(dq / sign_velocity). For a prismatic joint read N for N m and m for rad.
    """

    coulomb: float = 0.0
    """F_c [N m], >= 0"""
    viscous: float = 0.0
    """F_v [N m s/rad], >= 0"""
    offset: float = 0.0
    """F_o [N m], any sign"""
    static: float | None = None
    """F_s [N m], >= 0; None: no Stribeck peak"""
    stribeck_velocity: float | None = None
    """v_s [rad/s], > 0; given together with static"""
    load: float = 0.0
    """growth of F_c with the joint's load torque [1], >= 0"""
    sign_velocity: float = 1e-2
    """width of the smooth sign [rad/s], > 0"""
    presliding: float = 0.0
    """x_0: travel over which the sign turns over after a reversal, and which it is kept for at rest [rad], >= 0;
    0: no memory. The pipeline remembers; `Arm.friction_torque` has no past and takes the smooth sign"""

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name in ("coulomb", "viscous", "load", "presliding"):
            put(self, name, _number(getattr(self, name), f"friction {name}", low=0.0))
        put(self, "offset", _number(self.offset, "friction offset"))
        put(self, "sign_velocity", _number(self.sign_velocity, "friction sign_velocity", above=0.0))
        if (self.static is None) != (self.stribeck_velocity is None):
            raise ArmError(
                f"friction: give static and stribeck_velocity together or neither, "
                f"got {self.static!r} and {self.stribeck_velocity!r}"
            )
        if self.static is not None:
            put(self, "static", _number(self.static, "friction static", low=0.0))
            put(
                self,
                "stribeck_velocity",
                _number(self.stribeck_velocity, "friction stribeck_velocity", above=0.0),
            )


@dataclass(frozen=True, slots=True)
class Sensing:
    """What one joint's readings are worth. For a prismatic joint read m for rad, N for N m."""

    position_resolution: float = 0.0
    """one encoder count at the link [rad]; 0: no quantisation"""
    position_std: float = 0.0
    """standard deviation of the position noise, without the quantisation [rad]"""
    velocity_std: float | None = None
    """standard deviation of a measured velocity [rad/s]; None: velocity is not measured"""
    torque_resolution: float = 0.0
    """one step of the torque reading at the link [N m]; 0: no quantisation"""
    torque_std: float = 0.0
    """standard deviation of the torque noise, without the quantisation [N m]"""
    torque_gain_std: float = 0.0
    """standard deviation of the relative error of the torque scale, the same for all time [1]"""

    def __post_init__(self) -> None:
        for f in fields(self):
            if f.name != "velocity_std" or self.velocity_std is not None:
                value = _number(getattr(self, f.name), f"sensing {f.name}", low=0.0)
                object.__setattr__(self, f.name, value)


@dataclass(frozen=True, slots=True)
class Limits:
    """Range of one joint; infinite where unknown. For a prismatic joint read m for rad, N for N m."""

    lower: float = -math.inf
    """[rad]"""
    upper: float = math.inf
    """[rad], >= lower"""
    velocity: float = math.inf
    """largest speed [rad/s], > 0"""
    effort: float = math.inf
    """largest link-side motor torque [N m], > 0"""

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "velocity", "effort"):
            value = getattr(self, name)
            try:
                number = float(value)
            except (TypeError, ValueError, OverflowError):
                raise ArmError(f"limits {name} must be a number, got {value!r}") from None
            if math.isnan(number):
                raise ArmError(f"limits {name} must not be NaN")
            object.__setattr__(self, name, number)
        if self.lower > self.upper or self.lower == math.inf or self.upper == -math.inf:
            raise ArmError(f"limits: lower must not exceed upper, got [{self.lower!r}, {self.upper!r}]")
        for name in ("velocity", "effort"):
            if getattr(self, name) <= 0.0:
                raise ArmError(f"limits {name} must be > 0, got {getattr(self, name)!r}")


@dataclass(frozen=True, slots=True)
class Effort:
    """What the driver's "effort" number is; there is no default.

    See :meth:`torque`, :meth:`current` and :meth:`phase_currents`.
    """

    kind: Literal["torque", "current", "phase_currents", "undeclared"]
    k_t: tuple[float, ...] = (1.0,)
    """torque constants [N m/A], one for all joints or one per joint"""
    gear: tuple[float, ...] = (1.0,)
    """gear ratios, motor turns per link turn; negative where the motor turns the other way"""
    pole_pairs: tuple[float, ...] = (0.0,)
    """phase currents only: electrical turns per motor turn, 0 where not known"""
    angle_offset: tuple[float, ...] = (0.0,)
    """phase currents only: electrical angle at joint position 0 [rad]"""

    def __post_init__(self) -> None:
        if self.kind not in ("torque", "current", "phase_currents", "undeclared"):
            raise ArmError(
                f"effort kind must be torque, current, phase_currents or undeclared, got {self.kind!r}"
            )
        scales = self.kind in ("current", "phase_currents")
        for name, default, meant in (
            ("k_t", 1.0, scales),
            ("gear", 1.0, scales),
            ("pole_pairs", 0.0, self.kind == "phase_currents"),
            ("angle_offset", 0.0, self.kind == "phase_currents"),
        ):
            value: Any = getattr(self, name)
            values = tuple(value) if isinstance(value, Iterable) and not isinstance(value, str) else (value,)
            numbers = tuple(_number(v, f"effort {name}") for v in values)
            if not numbers or (default == 1.0 and 0.0 in numbers):
                raise ArmError(f"effort {name} must be numbers other than 0, got {value!r}")
            if name == "pole_pairs" and any(v < 0.0 or v != int(v) for v in numbers):
                raise ArmError(f"effort pole_pairs must be whole numbers, not negative, got {value!r}")
            if not meant and numbers != (default,):
                kinds = "kinds current and phase_currents" if default else "kind phase_currents"
                raise ArmError(f"effort {name} has a meaning for {kinds} only, this is {self.kind}")
            object.__setattr__(self, name, numbers)

    @classmethod
    def torque(cls) -> Effort:
        """The driver reports link-side torque [N m]."""
        return cls("torque")

    @classmethod
    def current(cls, k_t: float | Iterable[float], gear: float | Iterable[float] = 1.0) -> Effort:
        """The driver reports motor current [A]; link-side torque = current * k_t * gear.

        Args:
            k_t: torque constant [N m/A], one number or one per joint.
            gear: gear ratio [1], one number or one per joint; the sign turns the direction.

        Raises:
            ArmError: a value is zero or not finite.
        """
        return cls("current", k_t, gear)  # type: ignore[arg-type]

    @classmethod
    def phase_currents(
        cls,
        k_t: float | Iterable[float],
        gear: float | Iterable[float] = 1.0,
        pole_pairs: float | Iterable[float] = 0.0,
        angle_offset: float | Iterable[float] = 0.0,
    ) -> Effort:
        """Two phase currents per motor are measured [A]; :class:`palpate.PhaseCurrents` makes torque of them.

        Link-side torque = k_t * gear * I, I the peak of the phase currents with the sign of the torque.

        Args:
            k_t: torque constant per ampere of peak phase current [N m/A], one number or one per joint.
            gear: gear ratio [1], one number or one per joint; the sign turns the direction.
            pole_pairs: electrical turns per motor turn, 0 where not known.
            angle_offset: electrical angle at joint position 0 [rad].

        Raises:
            ArmError: a value is zero or not finite, or pole pairs are not whole numbers.
        """
        return cls("phase_currents", k_t, gear, pole_pairs, angle_offset)  # type: ignore[arg-type]

    @classmethod
    def undeclared(cls) -> Effort:
        """Nothing is known: models work, but asking for the gain is an error."""
        return cls("undeclared")

    def gain(self, n: int) -> Array:
        """Link-side torque per driver unit, shape (n,) [N m] or [N m/A].

        Raises:
            ArmError: nothing was declared, or a list's length is neither 1 nor n.
        """
        if self.kind == "undeclared":
            raise ArmError(
                "what the driver's effort number means is not declared: "
                "give the arm effort=Effort.torque(), Effort.current(k_t, gear) or Effort.phase_currents(...)"
            )
        for name in ("k_t", "gear", "pole_pairs", "angle_offset"):
            values = getattr(self, name)
            if len(values) not in (1, n):
                raise ArmError(f"effort {name} must hold 1 or {n} numbers, got {len(values)}")
        return np.ones(n) * np.array(self.k_t) * np.array(self.gear)


@dataclass(frozen=True, slots=True, eq=False)
class Shape(_Record):
    """A visual primitive fixed to a link (or to the base), for drawing and for contacts in simulation."""

    kind: Literal["box", "cylinder", "sphere", "capsule", "mesh"]
    size: tuple[float, ...]
    """[m] box: full lengths x, y, z; cylinder: radius, length along z; sphere: radius; capsule: radius,
    length along z between the centres of its caps; mesh: scale along x, y, z [1]"""
    T: Array
    """T_link_shape, (4, 4): the primitive's centre in the link frame [m]"""
    link: int
    """index of the joint that moves it; -1: fixed to the base"""
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.6, 1.0)
    filename: str | None = None
    """mesh only: as written in the source, never opened by palpate"""

    def __post_init__(self) -> None:
        count = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2, "mesh": 3}
        if self.kind not in count:
            raise ArmError(f"shape kind must be one of {', '.join(count)}, got {self.kind!r}")
        size = tuple(_number(s, f"size of a {self.kind}") for s in self.size)
        if len(size) != count[self.kind]:
            raise ArmError(f"a {self.kind} has {count[self.kind]} sizes, got {len(size)}")
        if self.kind != "mesh" and min(size) < 0.0:
            raise ArmError(f"sizes of a {self.kind} must be >= 0, got {size}")
        if (self.kind == "mesh") != (self.filename is not None):
            raise ArmError(
                f"a mesh, and nothing else, has a file name; this {self.kind} has {self.filename!r}"
            )
        rgba = tuple(_number(c, "rgba", low=0.0) for c in self.rgba)
        if len(rgba) != 4:
            raise ArmError(f"rgba has 4 numbers, got {len(rgba)}")
        put = object.__setattr__
        put(self, "size", size)
        put(self, "rgba", rgba)
        put(self, "link", int(self.link))
        put(self, "T", _placement(self.T, f"placement of a {self.kind}"))


@dataclass(frozen=True, slots=True, eq=False)
class Joint(_Record):
    """One moving joint and the link it moves; fixed joints are folded in, fixed bodies are lumped."""

    name: str
    link: str
    """name of the moved (child) link"""
    kind: Literal["revolute", "prismatic"]
    T_parent_joint: Array
    """(4, 4) [m]: joint frame at q = 0 in the previous link's frame, in the base frame for the first joint"""
    axis: Array
    """(3,) unit vector in the joint frame; q > 0 turns (or slides) about (along) it by the right-hand rule"""
    mass: float
    """[kg]; 0 only in an arm without dynamics"""
    com: Array
    """(3,) centre of mass in the link frame [m]"""
    inertia: Array
    """(3, 3) about the centre of mass, link axes [kg m^2]"""
    rotor_inertia: float = 0.0
    """reflected to the link side [kg m^2]"""
    friction: Friction = Friction()
    limits: Limits = Limits()
    sensing: Sensing = Sensing()

    def __post_init__(self) -> None:
        put = object.__setattr__
        where = f"joint {self.name!r}"
        for name in ("name", "link"):
            if not isinstance(getattr(self, name), str) or not getattr(self, name):
                raise ArmError(f"joint {name} must be a non-empty text, got {getattr(self, name)!r}")
        if self.kind not in ("revolute", "prismatic"):
            raise ArmError(f"{where}: kind must be revolute or prismatic, got {self.kind!r}")
        put(self, "T_parent_joint", _placement(self.T_parent_joint, f"{where}: T_parent_joint"))
        put(self, "axis", _array(self.axis, (3,), f"{where}: axis"))
        length = float(np.linalg.norm(self.axis))
        if abs(length - 1.0) > 1e-6:
            raise ArmError(
                f"{where}: axis must be a unit vector, {self.axis.tolist()} has length {length:.6g}"
            )
        put(self, "mass", _number(self.mass, f"{where}: mass", low=0.0))
        put(self, "com", _array(self.com, (3,), f"{where}: com"))
        inertia = _array(self.inertia, (3, 3), f"{where}: inertia")
        if np.any(np.abs(inertia - inertia.T) > 1e-6 * np.max(np.abs(inertia))):
            raise ArmError(f"{where}: inertia must be symmetric, got {inertia.tolist()}")
        # exact symmetry, so that a card can hold six numbers and still round-trip to the bit
        put(self, "inertia", _array(0.5 * (inertia + inertia.T), (3, 3), f"{where}: inertia"))
        put(self, "rotor_inertia", _number(self.rotor_inertia, f"{where}: rotor_inertia", low=0.0))
        for name, kind in (("friction", Friction), ("limits", Limits), ("sensing", Sensing)):
            if not isinstance(getattr(self, name), kind):
                raise ArmError(
                    f"{where}: {name} must be a palpate {kind.__name__}, got {getattr(self, name)!r}"
                )
        if self.mass == 0.0:
            if np.any(self.inertia) or np.any(self.com):
                raise ArmError(f"{where}: link {self.link!r} has no mass but a centre of mass or an inertia")
        else:
            complaint = inertia_complaint(self.inertia)
            if complaint:
                raise ArmError(f"{where}: link {self.link!r} with mass {self.mass:g} kg: {complaint}")

    def replace(self, **changes: Any) -> Joint:
        """A copy with the given fields changed; the same checks apply (ArmError)."""
        return replace(self, **changes)


def inertia_complaint(inertia: Array, *, definite: bool = True) -> str | None:
    """Why a (3, 3) inertia about the centre of mass [kg m^2] cannot belong to a body; None if it can.

    Principal moments must be positive (with ``definite=False`` also zero: a point mass) and the largest must
    not exceed the sum of the others. 1e-6 of the largest is allowed for the latter: tensors of thin bodies
    carry rounding.
    """
    low, mid, high = (float(v) for v in np.linalg.eigvalsh(inertia))
    moments = f"principal moments {low:.4g}, {mid:.4g}, {high:.4g} kg m^2"
    if not math.isfinite(low + mid + high):
        return f"inertia overflows: {inertia.tolist()}"
    if low <= 0.0 if definite else low < -1e-9 * max(high, 0.0):
        return f"inertia is not positive definite ({moments})"
    if low + mid < (1.0 - 1e-6) * high:
        return (
            f"inertia breaks the triangle inequality: {low:.4g} + {mid:.4g} < {high:.4g} kg m^2 ({moments})"
        )
    return None


@dataclass(frozen=True, slots=True, eq=False)
class Arm(_Record):
    """A serial arm of 1 to 16 moving joints, immutable; all model functions are pure.

    ``arm.core`` is the C++ model behind them; it is built on first use and then kept.
    """

    name: str
    joints: tuple[Joint, ...]
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    """(3,) [m/s^2] in the base frame; any direction: tilted and hanging mounts are ordinary"""
    T_last_tip: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) tip frame in the last link's frame [m]"""
    grasp: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) point at which a load is held, in the tip frame [m]"""
    effort: Effort = Effort("undeclared")
    shapes: tuple[Shape, ...] = ()
    base: str = "base"
    """name of the base frame"""
    tip: str = "tip"
    """name of the tip frame"""
    frames: Mapping[str, tuple[int, Array]] = field(default_factory=dict)
    """every fixed frame by name: (index of the joint that moves it, -1 for the base; T_link_frame (4, 4)).
    Base, links and tip are always in it"""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """where the numbers come from"""
    _core: Any = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        put = object.__setattr__
        if not isinstance(self.name, str) or not self.name:
            raise ArmError(f"an arm's name must be a non-empty text, got {self.name!r}")
        where = f"arm {self.name!r}"
        put(self, "joints", tuple(self.joints))
        if not all(isinstance(j, Joint) for j in self.joints):
            raise ArmError(f"{where}: joints must be palpate Joints")
        if not 1 <= len(self.joints) <= MAX_JOINTS:
            raise ArmError(f"{where}: must have 1 to {MAX_JOINTS} moving joints, got {len(self.joints)}")
        for what, names in (
            ("joint", [j.name for j in self.joints]),
            ("link", [j.link for j in self.joints]),
        ):
            twice = {name for name in names if names.count(name) > 1}
            if twice:
                raise ArmError(f"{where}: {what} name {min(twice)!r} is used twice")
        massless = [j.link for j in self.joints if j.mass == 0.0]
        if massless and len(massless) < self.n:
            raise ArmError(
                f"{where}: link {massless[0]!r} has no mass; all links must have one, or none (kinematics only)"
            )
        put(self, "gravity", _array(self.gravity, (3,), f"{where}: gravity"))
        put(self, "T_last_tip", _placement(self.T_last_tip, f"{where}: T_last_tip"))
        put(self, "grasp", _array(self.grasp, (3,), f"{where}: grasp"))
        if not isinstance(self.effort, Effort):
            raise ArmError(
                f"{where}: effort must be Effort.torque() or Effort.current(k_t, gear), got {self.effort!r}"
            )
        if self.effort.kind != "undeclared":
            self.effort.gain(self.n)
        put(self, "shapes", tuple(self.shapes))
        if not all(isinstance(s, Shape) and -1 <= s.link < self.n for s in self.shapes):
            raise ArmError(f"{where}: shapes must be palpate Shapes on links -1 (base) to {self.n - 1}")
        put(self, "frames", MappingProxyType(self._all_frames(where)))
        put(self, "provenance", MappingProxyType({str(k): str(v) for k, v in self.provenance.items()}))

    def _all_frames(self, where: str) -> dict[str, tuple[int, Array]]:
        """The given frames with those every arm has: base, links and tip."""
        identity = _array(np.eye(4), (4, 4), "identity")
        own = {self.base: (-1, identity)} | {j.link: (i, identity) for i, j in enumerate(self.joints)}
        if len(own) != self.n + 1:
            raise ArmError(f"{where}: the base and a link are both named {self.base!r}")
        if self.tip in own and (
            self.tip != self.joints[-1].link or not np.array_equal(self.T_last_tip, identity)
        ):
            raise ArmError(f"{where}: the tip's name {self.tip!r} belongs to another frame")
        frames = dict(own)
        for name, (link, T) in self.frames.items():
            if not isinstance(link, int | np.integer) or not -1 <= link < self.n:
                raise ArmError(
                    f"{where}: frame {name!r} must be on a link from -1 (base) to {self.n - 1}, got {link!r}"
                )
            placed = (int(link), _placement(T, f"{where}: frame {name!r}"))
            if name in own and not _same(placed, own[name]):
                raise ArmError(
                    f"{where}: frame {name!r} is a link of the chain and cannot be placed elsewhere"
                )
            frames[str(name)] = placed
        frames[self.tip] = (self.n - 1, self.T_last_tip)
        return frames

    @property
    def n(self) -> int:
        """Number of moving joints."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, base to tip."""
        return tuple(j.name for j in self.joints)

    @property
    def has_dynamics(self) -> bool:
        """False if the links have no masses: then only the kinematics work."""
        return self.joints[0].mass > 0.0

    @property
    def reach(self) -> float:
        """Length of the chain from the base to the grasp point [m]."""
        first = self.joints[0].T_parent_joint[:3, 3]
        return float(sum(np.linalg.norm(end) for end in (first, *self._link_ends())))

    def _link_ends(self) -> list[Array]:
        """Where each link ends, in its own frame [m]: at the next joint, the last one at the grasp point."""
        tip = self.T_last_tip
        return [j.T_parent_joint[:3, 3] for j in self.joints[1:]] + [tip[:3, :3] @ self.grasp + tip[:3, 3]]

    def solid_shapes(self) -> tuple[Shape, ...]:
        """Primitives to draw every link with: its own, or where it has none (or only meshes) a stand-in.

        A stand-in is a capsule to where the link ends and, of a moving link, a knob about its axis.
        """
        shapes = [s for s in self.shapes if s.kind != "mesh" and min(s.size) > 0.0]
        known = {s.link for s in shapes}
        radius = max(0.04 * self.reach, 0.005)
        first = self.joints[0].T_parent_joint[:3, 3]
        for link, end in [(-1, first), *enumerate(self._link_ends())]:
            if link in known:
                continue
            length = float(np.linalg.norm(end))
            if length > 1e-3:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = smallest_turn(end / length), 0.5 * end
                shapes.append(Shape("capsule", (0.8 * radius, length), T, link, _LINK_COLOUR))
            if link >= 0:
                T = np.eye(4)
                T[:3, :3] = smallest_turn(self.joints[link].axis)
                if self.joints[link].kind == "revolute":
                    shapes.append(Shape("cylinder", (radius, 2.2 * radius), T, link, _JOINT_COLOUR))
                else:
                    sides = (2.0 * radius, 2.2 * radius, 2.0 * radius)
                    shapes.append(Shape("box", sides, T, link, _JOINT_COLOUR))
        return tuple(shapes)

    def replace(self, **changes: Any) -> Arm:
        """A copy with the given fields changed; the same checks apply (ArmError)."""
        return replace(self, **changes)

    def __repr__(self) -> str:
        what = "" if self.has_dynamics else ", kinematics only"
        return f"Arm({self.name!r}: {self.n} joints from {self.base!r} to {self.tip!r}{what})"

    # --- building -------------------------------------------------------------------------------------------

    @classmethod
    def from_urdf(
        cls,
        source: str | PathLike[str],
        *,
        base: str | None = None,
        tip: str | None = None,
        effort: Effort | None = None,
        gravity: npt.ArrayLike | None = None,
        grasp: npt.ArrayLike | None = None,
        xacro_args: Mapping[str, str] | None = None,
        inertials: bool = True,
        repair_inertia: bool = False,
    ) -> Arm:
        """Reads the chain from ``base`` to ``tip`` out of a URDF.

        Fixed joints are folded in; whatever hangs beside or beyond the chain is lumped into the link that
        carries it, moving side joints (fingers) at their zero position. What comes before the base is
        ignored. ``<dynamics>`` gives viscous and Coulomb friction, ``<visual>`` the shapes (meshes by name
        only, never opened). Velocity and effort limits of 0 mean unknown. Keyword arguments win over the
        file's ``<palpate>`` element, which :meth:`to_urdf` writes and other readers skip.

        Args:
            source: path of a .urdf or .xacro file (the latter needs the extra ``xacro``), or XML text.
            base: base link; default: what the file states, else the root.
            tip: tip link; default: what the file states, else the leaf with the most moving joints before it.
            effort: what the driver's effort number is; default: what the file states, else undeclared.
            gravity: (3,) free fall in the base frame [m/s^2]; default: the file's, else (0, 0, -9.81).
            grasp: (3,) grasp point in the tip frame [m]; default: the file's for this tip, else its origin.
            xacro_args: arguments of a xacro file.
            inertials: False ignores all ``<inertial>`` elements: the arm has kinematics only.
            repair_inertia: True replaces inertias no body can have by the nearest possible ones, naming the
                links in ``provenance["inertia repaired"]``.

        Raises:
            ArmError: the file cannot be read or describes no such arm; names file, line, element and choices.
            MissingExtraError: a xacro file without the extra ``xacro``.
        """
        from ._urdf import read_urdf

        return read_urdf(
            source,
            base=base,
            tip=tip,
            effort=effort,
            gravity=gravity,
            grasp=grasp,
            xacro_args=xacro_args,
            inertials=inertials,
            repair_inertia=repair_inertia,
        )

    @classmethod
    def from_dh(
        cls,
        a: npt.ArrayLike,
        alpha: npt.ArrayLike,
        d: npt.ArrayLike,
        theta0: npt.ArrayLike | None = None,
        *,
        convention: Literal["standard", "modified"] = "standard",
        prismatic: Sequence[bool] | None = None,
        inertials: Sequence[tuple[float, npt.ArrayLike, npt.ArrayLike]] | None = None,
        joint_names: Sequence[str] | None = None,
        name: str = "arm",
        gravity: npt.ArrayLike = (0.0, 0.0, -9.81),
        grasp: npt.ArrayLike = (0.0, 0.0, 0.0),
        effort: Effort | None = None,
    ) -> Arm:
        """Builds an arm from Denavit-Hartenberg parameters.

        Standard (Denavit & Hartenberg 1955): T_{i-1,i} = Rz(theta0_i + q_i) Tz(d_i) Tx(a_i) Rx(alpha_i).
        Modified (Craig 1986): T_{i-1,i} = Rx(alpha_i) Tx(a_i) Rz(theta0_i + q_i) Tz(d_i); Craig
        writes a_{i-1} and alpha_{i-1} for these a_i and alpha_i. For a prismatic joint q_i adds to d_i. The
        tip is the last DH frame; DH frame i is ``arm.frames["dh_i"]``, counted from 1.

        Args:
            a, d: (n,) [m].
            alpha, theta0: (n,) [rad]; theta0 defaults to zeros.
            convention: ``"standard"`` or ``"modified"``.
            prismatic: (n,) which joints slide; default: none.
            inertials: per link (mass [kg], centre of mass (3,) [m], inertia (3, 3) about it [kg m^2]) in DH
                frame i; None: kinematics only, ``arm.has_dynamics`` is False and dynamics methods raise.
            joint_names: default joint_1, joint_2, ...
            gravity, grasp, effort: as in :meth:`from_urdf`.

        Raises:
            ArmError: lengths differ, or a value is not finite or not physical.
        """
        n = np.asarray(a, dtype=object).size
        lengths, twists, offsets = (
            _array(v, (n,), f"DH {k}") for k, v in (("a", a), ("alpha", alpha), ("d", d))
        )
        turns = _array(np.zeros(n) if theta0 is None else theta0, (n,), "DH theta0")
        names = tuple(f"joint_{i + 1}" for i in range(n)) if joint_names is None else tuple(joint_names)
        slides = (False,) * n if prismatic is None else tuple(prismatic)
        for what, values in (("joint_names", names), ("prismatic", slides), ("inertials", inertials)):
            if values is not None and len(values) != n:
                raise ArmError(f"{what} must have one entry per DH row, {n}, got {len(values)}")
        if convention not in ("standard", "modified"):
            raise ArmError(f"convention must be 'standard' or 'modified', got {convention!r}")

        T_link_dh = np.eye(4)
        joints, frames = [], {}
        for i in range(n):
            turn, slide, cross = _rotation_z(turns[i]), np.eye(4), _rotation_x(twists[i])
            slide[2, 3], cross[0, 3] = offsets[i], lengths[i]
            if convention == "standard":
                # joint i turns about z of DH frame i-1, so its link frame sits there and carries DH frame i
                T_parent_joint, T_link_dh = T_link_dh @ turn, slide @ cross
            else:
                T_parent_joint = cross @ slide @ turn
            frames[f"dh_{i + 1}"] = (i, T_link_dh)
            mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
            if inertials is not None:
                mass = _number(inertials[i][0], f"mass of link {i + 1}", above=0.0)
                R = T_link_dh[:3, :3]
                com = R @ _array(inertials[i][1], (3,), f"com of link {i + 1}") + T_link_dh[:3, 3]
                inertia = R @ _array(inertials[i][2], (3, 3), f"inertia of link {i + 1}") @ R.T
            joints.append(
                Joint(
                    name=names[i],
                    link=f"link_{i + 1}",
                    kind="prismatic" if slides[i] else "revolute",
                    T_parent_joint=T_parent_joint,
                    axis=np.array([0.0, 0.0, 1.0]),
                    mass=mass,
                    com=com,
                    inertia=inertia,
                )
            )
        return cls(
            name=name,
            joints=tuple(joints),
            gravity=np.asarray(gravity),
            T_last_tip=T_link_dh,
            grasp=np.asarray(grasp),
            effort=effort or Effort.undeclared(),
            frames=frames,
        )

    @classmethod
    def from_card(cls, path: str | PathLike[str]) -> Arm:
        """Reads a card (YAML) that :meth:`save` wrote, or a person did.

        Raises:
            ArmError: the file cannot be read, or a field is unknown, missing or wrong; names the field.
            MissingExtraError: without the extra ``card``.
        """
        from ._card import read_card

        return read_card(path)

    # --- writing --------------------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the card: YAML, units in the key names, every number exact to the bit.

        Raises:
            ArmError: the file cannot be written.
            MissingExtraError: without the extra ``card``.
        """
        from ._card import write_card

        write_card(self, path)

    def to_urdf(self) -> str:
        """The arm as URDF text; what URDF cannot say is in a ``<palpate>`` element that other readers skip.

        :meth:`from_urdf` reads it back; rotations pass through roll, pitch and yaw and so are exact to about
        1e-15 only. An arm without dynamics is written without ``<inertial>`` and read back with
        ``inertials=False``.

        Raises:
            ArmError: a name or a provenance text holds characters that XML cannot.
        """
        from ._urdf import write_urdf

        return write_urdf(self)

    def to_header(self, name: str | None = None) -> str:
        """A C++20 header holding the arm as ``inline constexpr palpate::ArmDescription <name>``.

        Args:
            name: C++ identifier; default: the arm's name.

        Raises:
            ArmError: the name is no C++ identifier, or the effort is undeclared.
        """
        from ._header import write_header

        return write_header(self, self.name if name is None else name)

    # --- model ----------------------------------------------------------------------------------------------

    @property
    def core(self) -> CoreArm:
        """The C++ model, built on first use.

        An undeclared effort is passed on as gain 1; who feeds driver samples must ask ``effort.gain(n)``.
        """
        if self._core is None:
            object.__setattr__(self, "_core", self._build_core())
        return self._core

    def _build_core(self) -> CoreArm:
        from ._core import Arm as CoreArm

        def optional(value: float | None) -> float:
            return math.nan if value is None else value

        joints = self.joints
        friction = [
            (
                f.coulomb,
                f.viscous,
                f.offset,
                optional(f.static),
                optional(f.stribeck_velocity),
                f.load,
                f.sign_velocity,
                f.presliding,
            )
            for f in (j.friction for j in joints)
        ]
        sensing = [
            (
                s.position_resolution,
                s.position_std,
                optional(s.velocity_std),
                s.torque_resolution,
                s.torque_std,
                s.torque_gain_std,
            )
            for s in (j.sensing for j in joints)
        ]
        limits = [(x.lower, x.upper, x.velocity, x.effort) for x in (j.limits for j in joints)]
        try:
            return CoreArm(
                self.n,
                np.stack([j.T_parent_joint for j in joints]),
                np.stack([j.axis for j in joints]),
                np.array([j.kind == "prismatic" for j in joints], dtype=np.float64),
                np.array([j.mass for j in joints]),
                np.stack([j.com for j in joints]),
                np.stack([j.inertia for j in joints]),
                np.array([j.rotor_inertia for j in joints]),
                np.array(friction, dtype=np.float64),
                np.array(limits, dtype=np.float64),
                np.array(sensing, dtype=np.float64),
                np.ones(self.n) if self.effort.kind == "undeclared" else self.effort.gain(self.n),
                self.gravity,
                self.T_last_tip,
                self.grasp,
            )
        except ValueError as e:
            raise ArmError(f"arm {self.name!r}: {e}") from None

    def _rows(self, **vectors: npt.ArrayLike) -> tuple[list[Array], bool]:
        """The vectors as (N, n) arrays, and whether a single (n,) pose came in."""
        rows: list[Array] = []
        shape: tuple[int, ...] | None = None
        for what, value in vectors.items():
            try:
                array = np.asarray(value, dtype=np.float64, order="C")
            except (TypeError, ValueError):
                raise ArmError(
                    f"{what} must be numbers of shape ({self.n},) or (N, {self.n}), got {value!r:.80}"
                ) from None
            if array.ndim not in (1, 2) or array.shape[-1] != self.n:
                raise ArmError(f"{what} must have shape ({self.n},) or (N, {self.n}), got {array.shape}")
            if shape is not None and array.shape != shape:
                raise ArmError(
                    f"{what} must have the same shape as {next(iter(vectors))}, {shape}, got {array.shape}"
                )
            if not np.all(np.isfinite(array)):
                raise ArmError(
                    f"{what} must be finite; entry {np.argwhere(~np.isfinite(array))[0].tolist()} is not"
                )
            shape = array.shape
            rows.append(array.reshape(-1, self.n))
        return rows, len(shape or ()) == 1

    def _dynamic_rows(self, **vectors: npt.ArrayLike) -> tuple[list[Array], bool]:
        if not self.has_dynamics:
            raise ArmError(
                f"arm {self.name!r} has no masses (kinematics only), so its dynamics cannot be computed"
            )
        return self._rows(**vectors)

    def inverse_dynamics(self, q: npt.ArrayLike, dq: npt.ArrayLike, ddq: npt.ArrayLike) -> Array:
        """M(q) ddq + C(q, dq) dq + g(q), rotor inertias included, friction not [N m].

        Args:
            q, dq, ddq: (n,) or (N, n) [rad, rad/s, rad/s^2].

        Returns:
            same shape.

        Raises:
            ArmError: shapes differ, a value is not finite, or the arm has no dynamics.
        """
        rows, single = self._dynamic_rows(q=q, dq=dq, ddq=ddq)
        return _unwrap(self.core.inverse_dynamics(*rows), single)

    def forward_dynamics(self, q: npt.ArrayLike, dq: npt.ArrayLike, tau: npt.ArrayLike) -> Array:
        """M(q)^-1 (tau - C(q, dq) dq - g(q)) [rad/s^2]; subtract friction from tau, add tau_ext to it.

        Args:
            q, dq, tau: (n,) or (N, n) [rad, rad/s, N m].

        Returns:
            same shape.

        Raises:
            ArmError: as in :meth:`inverse_dynamics`.
        """
        rows, single = self._dynamic_rows(q=q, dq=dq, tau=tau)
        return _unwrap(self.core.forward_dynamics(*rows), single)

    def mass_matrix(self, q: npt.ArrayLike) -> Array:
        """M(q), rotor inertias included, (n, n) or (N, n, n) [kg m^2].

        Raises:
            ArmError: as in :meth:`inverse_dynamics`.
        """
        rows, single = self._dynamic_rows(q=q)
        return _unwrap(self.core.mass_matrix(*rows), single)

    def momentum_terms(self, q: npt.ArrayLike, dq: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """What a momentum observer needs (MATH.md section 2), each in the shape of q.

        Returns:
            p = M dq [N m s], C(q, dq)^T dq [N m], g(q) [N m].

        Raises:
            ArmError: as in :meth:`inverse_dynamics`.
        """
        rows, single = self._dynamic_rows(q=q, dq=dq)
        p, ct_dq, g = self.core.momentum_terms(*rows)
        return _unwrap(p, single), _unwrap(ct_dq, single), _unwrap(g, single)

    def gravity_torque(self, q: npt.ArrayLike) -> Array:
        """g(q) [N m], in the shape of q: what the motors bear at rest.

        Raises:
            ArmError: as in :meth:`inverse_dynamics`.
        """
        (rows,), single = self._dynamic_rows(q=q)
        return _unwrap(self.core.momentum_terms(rows, np.zeros_like(rows))[2], single)

    def regressor(self, q: npt.ArrayLike, dq: npt.ArrayLike, ddq: npt.ArrayLike) -> Array:
        """Y with M ddq + C dq + g = Y pi (+ I_a ddq for rotor inertias), (n, 10 n) or (N, n, 10 n).

        pi holds per link, in link axes about the joint frame: m, m c_x, m c_y, m c_z, I_xx, I_xy, I_xz, I_yy,
        I_yz, I_zz [kg, kg m, kg m^2]. Works without masses.

        Raises:
            ArmError: a shape is wrong or a value is not finite.
        """
        rows, single = self._rows(q=q, dq=dq, ddq=ddq)
        return _unwrap(self.core.regressor(*rows), single)

    def friction_torque(self, dq: npt.ArrayLike) -> Array:
        """tau_f(dq) [N m] in the shape of dq [rad/s], without the load-dependent part.

        Raises:
            ArmError: a shape is wrong or a value is not finite.
        """
        rows, single = self._rows(dq=dq)
        return _unwrap(self.core.friction_torque(*rows), single)

    def forward_kinematics(self, q: npt.ArrayLike) -> Array:
        """T_base_tip, (4, 4) or (N, 4, 4) [m], for q (n,) or (N, n) [rad].

        Raises:
            ArmError: a shape is wrong or a value is not finite.
        """
        rows, single = self._rows(q=q)
        return _unwrap(self.core.forward_kinematics(*rows), single)

    def jacobian(self, q: npt.ArrayLike, point: npt.ArrayLike | None = None) -> Array:
        """Jacobian of a point fixed in the tip frame, (6, n) or (N, 6, n): rows 0-2 linear, 3-5 angular.

        Velocities are in the base frame, as seen from it: J dq = (v [m/s], w [rad/s]).

        Args:
            q: (n,) or (N, n) [rad].
            point: (3,) in the tip frame [m]; default: the tip's origin. The grasp point is ``arm.grasp``.

        Raises:
            ArmError: a shape is wrong or a value is not finite.
        """
        rows, single = self._rows(q=q)
        at = np.zeros(3) if point is None else _array(point, (3,), "point")
        return _unwrap(self.core.jacobian(*rows, at), single)

    def weighing_joint(
        self,
        q: npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike],
        *,
        min_perpendicularity: float = 0.8,
        min_radius: float = 0.05,
        min_sin_angle: float = 0.2,
    ) -> WeighingJoint:
        """The joint whose torque tells best what a held load weighs: m = tau_ext,i / (J_i^T gravity).

        It is the joint nearest to the tip that turns about an axis nearly perpendicular to gravity (or slides
        nearly along it) with the grasp point off its axis: fewer joints between load and reading, so less of
        the arm's own weight and friction is in it.

        Args:
            q: one pose (n,) [rad]; poses (N, n); or a tuple (lowest (n,), highest (n,)) spanning a box of
                poses, which is sampled at both ends and at 1024 fixed pseudo-random poses in between.
            min_perpendicularity: what "nearly" means, 0..1, to hold in every pose; 0.8 is 37 degrees off.
            min_radius: least distance of the grasp point from the axis of a revolute joint [m], in every pose.
            min_sin_angle: a joint that reaches this sin_angle in none of the poses is taken only if no other
                that qualifies does.

        Raises:
            ArmError: a shape is wrong, gravity is zero, or no joint qualifies (lists every joint's figures).
        """
        strength = float(np.linalg.norm(self.gravity))
        if strength == 0.0:
            raise ArmError(f"arm {self.name!r}: nothing can be weighed without gravity")
        J = self.core.jacobian(self._poses(q), self.grasp)
        down = self.gravity / strength
        found: list[tuple[bool, WeighingJoint]] = []
        report = []
        for i in reversed(range(self.n)):
            levers = np.abs(J[:, :3, i] @ down)
            if self.joints[i].kind == "prismatic":
                uprightness, radii = levers, np.ones_like(levers)
            else:
                uprightness = np.linalg.norm(np.cross(J[:, 3:, i], down), axis=-1)
                radii = np.linalg.norm(J[:, :3, i], axis=-1)
            perpendicularity, radius = float(uprightness.min()), float(radii.min())
            report.append(f"{self.joints[i].name} {perpendicularity:.2f}, {radius:.3f} m")
            if perpendicularity < min_perpendicularity or radius < min_radius:
                continue
            sines = levers / (radii * uprightness)
            joint = WeighingJoint(
                index=i,
                name=self.joints[i].name,
                lever=float(levers.min()),
                lever_max=float(levers.max()),
                radius=radius,
                perpendicularity=perpendicularity,
                sin_angle=float(sines.min()),
            )
            found.append((bool(sines.max() >= min_sin_angle), joint))
        if not found:
            raise ArmError(
                f"arm {self.name!r}: no joint weighs here: perpendicularity to gravity must be at least "
                f"{min_perpendicularity:g} and distance of the grasp point from the axis {min_radius:g} m; got "
                + "; ".join(report)
            )
        return next((joint for reaches, joint in found if reaches), found[0][1])

    def _poses(self, q: Any) -> Array:
        """What :meth:`weighing_joint` takes as q, as rows."""
        if not (isinstance(q, tuple) and len(q) == 2 and not np.isscalar(q[0])):
            (rows,), _ = self._rows(q=q)
            if len(rows) == 0:
                raise ArmError("q must hold at least one pose")
            return rows
        low, high = (_array(end, (self.n,), "end of the range") for end in q)
        if np.any(low > high):
            raise ArmError(f"range: lowest must not exceed highest, got {low.tolist()} and {high.tolist()}")
        inside = np.random.default_rng(0).random((1024, self.n))
        return np.asarray(low + np.vstack([np.zeros(self.n), np.ones(self.n), inside]) * (high - low))


@dataclass(frozen=True, slots=True)
class WeighingJoint:
    """Which joint weighs a held load, and how well; the worst case over the poses asked for."""

    index: int
    name: str
    lever: float
    """smallest |J_i^T gravity| / |gravity| at the grasp point [m], or [1] if prismatic: torque per newton"""
    lever_max: float
    """largest of the same"""
    radius: float
    """smallest distance of the grasp point from the joint's axis [m]; 1 for a prismatic joint"""
    perpendicularity: float
    """smallest sine of the angle between axis and gravity; for a prismatic joint the smallest cosine"""
    sin_angle: float
    """lever / (radius * perpendicularity): sine of the angle between the arm from axis to grasp point and
    gravity, in the plane the joint turns in; the theta of m = -tau / (g l sin theta)"""


def _unwrap(rows: Array, single: bool) -> Array:
    return rows[0] if single else rows


def _rotation_x(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def _rotation_z(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]])
