"""Other programs identify the same arms from the same files (extra ``bench``); none of them is needed by palpate.

All get the same plain data: positions on a uniform grid, low-passed without phase, velocities and accelerations as
differences; regressor and torque then go through one more low-pass, and every fourth row is kept.
"""

from __future__ import annotations

import gzip
import os
import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arm import Array
from ..errors import PalpateError
from ..identify.data import low_pass
from ..logs import Log

CUTOFF = 5.0
"""of the low-pass of regressor and torque [Hz]"""
KINEMATIC = 20.0
"""of the low-pass of the positions, where a regressor is filtered afterwards [Hz]"""
STEP = 4
"""every so many rows"""
SYSID_ROWS = 500
"""rows that mujoco's sysid gets: it takes finite differences of a model compiled anew for every parameter"""
SYSID_ITERATIONS = 12
"""of its optimiser"""
SLOW = (0.05009095, 0.05009095, 0.07504916, 0.0715585, 0.05585054, 0.12217305)
"""rows slower than this are dropped by figaroh's example [rad/s]"""
RATIO = (32.0, 32.0, 45.0, -48.0, 45.0, 32.0)
"""gear ratios of the TX40"""


class NotHere(PalpateError):
    """A rival cannot run; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """What a rival made of the UR10e."""

    name: str
    time: Array
    """(M,) of the judged log [s]"""
    measured: Array
    """(M, n) [N m]"""
    predicted: Array
    """(M, n) [N m]"""
    rows: int
    """of the fit, per joint"""
    seconds: float
    """from the plain data to the parameters"""
    note: str


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """What figaroh made of its own example."""

    residual: float
    """relative, on its own data [1]"""
    held_out: float
    """relative, on the last third by a fit of the rest [1]"""
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Plain:
    """One log on a uniform grid, (N, n)."""

    time: Array
    q: Array
    dq: Array
    ddq: Array
    torque: Array
    period: float

    @classmethod
    def of(cls, log: Log, gain: Array, cutoff: float) -> Plain:
        """Positions low-passed at `cutoff` [Hz]; the torque is as measured."""
        period = float(np.median(np.diff(log.seconds)))
        at = np.arange(log.seconds[0], log.seconds[-1], period)

        def grid(values: Array) -> Array:
            return np.column_stack([np.interp(at, log.seconds, column) for column in values.T])

        q = low_pass(grid(log.position), 1.0 / period, cutoff)
        dq = np.gradient(q, period, axis=0)
        return cls(at, q, dq, np.gradient(dq, period, axis=0), grid(log.effort) * gain, period)

    def reduce(self, values: Array) -> Array:
        """Low-passed, without the filter's ends, every few rows."""
        return low_pass(values, 1.0 / self.period, CUTOFF)[20:-20:STEP]


def identify(name: str, urdf: Path, free: Sequence[Log], judged: Log, gain: Array) -> Rival:
    """Let `pinocchio`, `figaroh` or `sysid` identify the arm and predict the judged log.

    Raises:
        NotHere: it is not installed, or does not run.
    """
    run: Callable[..., tuple[str, Array, int, float, str]] = {
        "pinocchio": _pinocchio,
        "figaroh": _figaroh,
        "sysid": _sysid,
    }[name]
    cutoff = CUTOFF if name == "sysid" else KINEMATIC
    train, test = [Plain.of(log, gain, cutoff) for log in free], Plain.of(judged, gain, cutoff)
    with _quiet():
        title, guess, rows, seconds, note = run(urdf, train, test, len(gain))
    return Rival(title, test.time[20:-20:STEP], test.reduce(test.torque), guess, rows, seconds, note)


def _imported(module: str, package: str) -> Any:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise NotHere(
            f"{package} is not installed or does not import: {error}; pip install 'palpate[bench]'"
        ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Rivals print and warn as they like."""
    with (
        warnings.catch_warnings(),
        np.errstate(all="ignore"),
        open(os.devnull, "w") as nowhere,
        redirect_stdout(nowhere),
    ):
        warnings.simplefilter("ignore")
        yield


# --- UR10e ------------------------------------------------------------------------------------------------------------


def _pinocchio(urdf: Path, train: Sequence[Plain], test: Plain, n: int) -> tuple[str, Array, int, float, str]:
    pin = _imported("pinocchio", "pin")
    model = pin.buildModelFromUrdf(str(urdf))
    data = model.createData()

    def regressor(d: Plain) -> Array:
        rigid = np.array(
            [pin.computeJointTorqueRegressor(model, data, *row) for row in zip(d.q, d.dq, d.ddq, strict=True)]
        )
        wide = np.zeros((len(d.q), n, 4 * n))
        for j in range(n):
            columns = (d.ddq[:, j], d.dq[:, j], np.sign(d.dq[:, j]), np.ones(len(d.q)))
            wide[:, j, 4 * j : 4 * j + 4] = np.column_stack(columns)
        return d.reduce(np.concatenate([rigid, wide], axis=2))

    begin = time.perf_counter()
    A = np.concatenate([regressor(d) for d in train])
    right = np.concatenate([d.reduce(d.torque) for d in train])
    phi = np.linalg.lstsq(A.reshape(-1, A.shape[2]), right.ravel(), rcond=None)[0]
    seconds = time.perf_counter() - begin
    note = "ordinary least squares with rotor inertia, Coulomb and viscous friction and offset"
    return f"Pinocchio {pin.__version__} regressor + numpy", regressor(test) @ phi, len(A), seconds, note


_FIGAROH = {
    "has_friction": True,
    "has_actuator_inertia": True,
    "has_joint_offset": True,
    "is_joint_torques": True,
}


def _figaroh(urdf: Path, train: Sequence[Plain], test: Plain, n: int) -> tuple[str, Array, int, float, str]:
    robot = _figaroh_robot(urdf)
    basic = _imported("figaroh.tools.regressor", "figaroh").build_regressor_basic
    settings = _FIGAROH | {"act_idxv": list(range(n))}

    def regressor(d: Plain) -> Array:
        """(M, n, p), from figaroh's order: all rows of the first joint, then of the second."""
        W = basic(robot, d.q, d.dq, d.ddq, settings)
        return d.reduce(W.reshape(n, len(d.q), -1).transpose(1, 0, 2))

    begin = time.perf_counter()
    A = np.concatenate([regressor(d) for d in train])
    W = A.transpose(1, 0, 2).reshape(-1, A.shape[2])
    tau = np.concatenate([d.reduce(d.torque) for d in train]).T.ravel()
    base, phi = _base(W, tau)
    phi = _weighted(W[:, base], tau, [len(A)] * n, phi)
    seconds = time.perf_counter() - begin
    note = "base parameters by its double QR, weighted least squares as in its example"
    return "figaroh 1.0.2", regressor(test)[:, :, base] @ phi, len(A), seconds, note


def _figaroh_robot(urdf: Path) -> Any:
    """figaroh's robot of a URDF without its meshes."""
    import tempfile

    load = _imported("figaroh.tools.robot", "figaroh").Robot
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(_bare(urdf))
        return load(str(path), package_dirs=folder)


def _bare(urdf: Path) -> str:
    """The URDF without visual and collision geometry."""
    return re.sub(r"<(visual|collision)\b.*?</\1>", "", urdf.read_text(), flags=re.DOTALL)


def _base(W: Array, tau: Array) -> tuple[list[int], Array]:
    """The columns of the base parameters, and their values by figaroh's QR."""
    qr = _imported("figaroh.tools.qrdecomposition", "figaroh").QRDecomposer()
    felt = np.flatnonzero(np.einsum("ij,ij->j", W, W) >= 1e-3)
    result = qr.double_decomposition(tau, W[:, felt], [f"p{k}" for k in felt])
    return [int(felt[k]) for k in qr.base_indices], np.asarray(result[3])


def _weighted(W: Array, tau: Array, counts: Sequence[int], phi: Array) -> Array:
    """Weighted least squares by joint; `counts` rows belong to each."""
    joint = np.repeat(np.arange(len(counts)), counts)
    square = np.bincount(joint, np.square(tau - W @ phi)) / counts
    root = 1.0 / np.sqrt(square[joint])
    return np.asarray(np.linalg.lstsq(W * root[:, None], tau * root, rcond=None)[0], dtype=np.float64)


def _sysid(urdf: Path, train: Sequence[Plain], test: Plain, n: int) -> tuple[str, Array, int, float, str]:
    mujoco = _imported("mujoco", "mujoco-core")
    sysid = _imported("mujoco.sysid", "mujoco-core")
    if not hasattr(sysid, "optimize"):
        raise NotHere("mujoco's sysid lacks its own needs: pip install 'mujoco-core[sysid]'")
    spec = mujoco.MjSpec.from_string(_bare(urdf))
    model = spec.compile()
    params = sysid.ParameterDict()
    for k in range(model.nbody - n, model.nbody):
        kind, name = sysid.InertiaType.Pseudo, model.body(k).name
        params.add(
            sysid.body_inertia_param(spec, model, name, kind, modifier=_principal(mujoco, sysid, name))
        )
    for name, unit, low, high in (
        ("rotor", 0.1, 0.0, 20.0),
        ("viscous", 5.0, 0.0, 100.0),
        ("coulomb", 5.0, 0.0, 100.0),
        ("offset", 0.0, -20.0, 20.0),
    ):
        params.add(sysid.Parameter(name, np.full(n, unit), np.full(n, low), np.full(n, high)))

    def torque(model: Any, values: Any, d: Plain) -> Array:
        data = mujoco.MjData(model)
        out = np.empty_like(d.q)
        for k in range(len(out)):
            data.qpos[:], data.qvel[:], data.qacc[:] = d.q[k], d.dq[k], d.ddq[k]
            mujoco.mj_inverse(model, data)
            out[k] = data.qfrc_inverse
        out += values["rotor"].value * d.ddq + values["viscous"].value * d.dq
        out += values["coulomb"].value * np.sign(d.dq) + values["offset"].value
        return out

    together = {
        name: np.concatenate([getattr(d, name)[20:-20:STEP] for d in train])
        for name in ("time", "q", "dq", "ddq")
    } | {"torque": np.concatenate([d.reduce(d.torque) for d in train])}
    pick = np.linspace(0, len(together["q"]) - 1, SYSID_ROWS).astype(int)
    few = Plain(**{name: values[pick] for name, values in together.items()}, period=train[0].period)
    size = np.std(few.torque, axis=0)

    def residual(x: Array, values: Any) -> tuple[list[Array], None, None]:
        """Of one vector of parameters, or of every column of a matrix of them."""
        found = []
        for column in x.reshape(len(x), -1).T:
            values.update_from_vector(column)
            error = (torque(sysid.apply_param_modifiers(values, spec), values, few) - few.torque) / size
            found.append(error.ravel())
        return [np.column_stack(found) if x.ndim > 1 else found[0]], None, None

    begin = time.perf_counter()
    found, _ = sysid.optimize(params, residual, verbose=False, max_iters=SYSID_ITERATIONS)
    seconds = time.perf_counter() - begin
    guess = test.reduce(torque(sysid.apply_param_modifiers(found, spec), found, test))
    note = (
        f"pseudo-inertias, {SYSID_ITERATIONS} iterations of its optimiser on mj_inverse; no second low-pass"
    )
    return f"mujoco {mujoco.__version__} sysid", guess, SYSID_ROWS, seconds, note


def _principal(mujoco: Any, sysid: Any, name: str) -> Callable[[Any, Any], None]:
    """Sysid's modifier of a body's inertia, by principal axes: its own sets the inertia to 0, which 4.0.1 refuses."""

    def modify(spec: Any, param: Any) -> None:
        pi = sysid.model_modifier.pi_from_theta(param.value)
        body = spec.body(name)
        body.explicitinertial = True
        body.mass, body.ipos = pi[0], pi[1:4] / pi[0]
        cross = sysid.model_modifier.skew(body.ipos)
        values, axes = np.linalg.eigh(pi[4:].reshape(3, 3) + pi[0] * cross @ cross)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, axes.ravel())
        body.inertia, body.iquat, body.fullinertia = values, turn, np.full((6, 1), np.nan)

    return modify


# --- figaroh's TX40 example -------------------------------------------------------------------------------------------


def figaroh_tx40(folder: Path) -> Example:
    """figaroh's own steps for the TX40, with its functions, on its own files.

    Low-pass at its 100 Hz, differences, rotor inertia, friction, offset and the wrist's coupling, decimation by 10
    twice, rows near zero velocity dropped, base parameters by double QR, weighted least squares.

    Raises:
        NotHere: figaroh is not installed.
    """
    from scipy import signal

    settings = _FIGAROH | {"act_idxv": list(range(6)), "ts": 2e-4, "cut_off_frequency_butterworth": 100.0}
    with _quiet():
        tools = _imported("figaroh.identification.identification_tools", "figaroh")
        basic = _imported("figaroh.tools.regressor", "figaroh").build_regressor_basic
        robot = _figaroh_robot(folder / "tx40_mdh_modified.urdf")
        effort, motor = (_csv(folder / f"{name}.csv.gz") for name in ("curr_data", "pos_read_data"))
        begin = time.perf_counter()
        turn, push = np.diag(RATIO), np.diag(RATIO)
        turn[5, 4] = push[4, 5] = RATIO[5]
        q = tools.low_pass_filter_data(motor @ np.linalg.inv(turn).T, settings, 4)
        q[:, 1] -= 0.5 * np.pi
        q[:, 2] += 0.5 * np.pi
        q, dq, ddq = tools.calculate_first_second_order_differentiation(robot.model, q, settings)
        count = len(q)
        tau = (effort @ push.T)[20 : 20 + count]
        W = np.c_[basic(robot, q, dq, ddq, settings), np.zeros((6 * count, 3))]
        sign = np.sign(dq[:, 4] + dq[:, 5])
        W[4 * count : 5 * count, -3:] = np.column_stack([ddq[:, 5], dq[:, 5], sign])
        W[5 * count :, -3:] = np.column_stack([ddq[:, 4], dq[:, 4], sign])

        def fewer(values: Array) -> Array:
            for _ in range(2):
                values = signal.decimate(values, q=10, zero_phase=True, axis=0)
            return values

        blocks = [fewer(W[j * count : (j + 1) * count]) for j in range(6)]
        right = [fewer(tau[:, j]) for j in range(6)]
        speed = fewer(dq)
        moving = [np.flatnonzero(np.abs(speed[:, j]) >= SLOW[j]) for j in range(6)]
        parts = {
            what: [rows[(rows < len(speed) * last) & (rows >= len(speed) * first)] for rows in moving]
            for what, first, last in (("all", 0.0, 1.0), ("first", 0.0, 2 / 3), ("last", 2 / 3, 1.0))
        }

        def rows(what: str) -> tuple[Array, Array]:
            pairs = list(zip(blocks, right, parts[what], strict=True))
            return np.concatenate([b[r] for b, _, r in pairs]), np.concatenate([t[r] for _, t, r in pairs])

        def residual(train: str, test: str) -> float:
            A, y = rows(train)
            base, phi = _base(A, y)
            phi = _weighted(A[:, base], y, [len(r) for r in parts[train]], phi)
            B, z = rows(test)
            return float(np.linalg.norm(z - B[:, base] @ phi) / np.linalg.norm(z))

        own = residual("all", "all")
        seconds = time.perf_counter() - begin
        return Example(own, residual("first", "last"), seconds)


def _csv(path: Path) -> Array:
    with gzip.open(path, "rt") as file:
        return np.loadtxt(file, delimiter=",", skiprows=1)
