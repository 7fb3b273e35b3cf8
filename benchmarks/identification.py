"""Identification measured on recordings of real robots; prints one line per figure.

python benchmarks/identification.py [ur10e] [gains] [load] [tx40] [kuka] [kinova] [xl330] [cutoff]

The recordings are read from the folder PALPATE_DATA names, or from ../shared/data beside the clone. Nothing is
tuned to a file: every fit uses palpate.identify's defaults unless the line says otherwise.
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

import numpy as np

from palpate import Arm, Effort, Joint
from palpate.identify import (
    Coupling,
    Fit,
    KnownLoad,
    estimate_load,
    fit,
    fit_bus_drive,
    fit_gains,
    fit_transmission,
    prepare,
)
from palpate.identify.load import LoadProblem
from palpate.identify.regress import LINK_TERMS, Builder
from palpate.logs import ColumnMap, Log, read_bam, read_tx40

DATA = Path(os.environ.get("PALPATE_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
UR = DATA / "ur10e_innopolis"
GAIN = np.array([11.976, 11.976, 9.839, 10.763, 10.763, 10.763])
MASS = 2.805
FREE = (
    "ur-20_01_31-unload",
    "ur-20_02_10-30sec_12harm",
    "ur-20_02_12-40sec_12harm",
    "ur-20_02_19_14harm50sec",
)
LOADED = ("ur-20_01_31-load", "ur-20_02_19_14harm50secLoad")
TX40_COULOMB = np.array([7.14, 8.26, 6.34, 2.48, 3.03, 0.282])

np.set_printoptions(linewidth=150, precision=3, suppress=True)


def ur10e() -> tuple[Arm, list[Log], list[Log], Log]:
    arm = Arm.from_urdf(UR / "ur10e.urdf", tip="tool0", effort=Effort.current(GAIN))
    columns = ColumnMap.named("ur10e")
    free, loaded = (
        [Log.open(UR / "identification_data" / f"{name}.csv", columns) for name in names]
        for names in (FREE, LOADED)
    )
    return arm, free, loaded, Log.open(UR / "validation_data" / "ur-20_01_17-ptp_10_points.csv", columns)


def tx40() -> tuple[Arm, Log]:
    folder = DATA / "staubli_tx40"
    arm = Arm.from_urdf(folder / "tx40_mdh_modified.urdf", repair_inertia=True, effort=Effort.torque())
    return arm, read_tx40(folder / "pos_read_data.csv.gz", folder / "curr_data.csv.gz")


def kuka() -> tuple[Arm, list[Log]]:
    folder = DATA / "kuka_lwr4_iit"
    # the file gives the first joint two origins; the pedestal's height is of no matter to the dynamics
    text = (folder / "kuka_lwr4.urdf").read_text().replace('<origin rpy="0 0 0" xyz="-0.25 0 1"/>\n', "", 1)
    arm = Arm.from_urdf(text, repair_inertia=True, effort=Effort.torque())
    columns = ColumnMap.named("kuka_lwr4")
    return arm, [Log.open(folder / f"measurements_{k}.npz", columns) for k in (1, 2)]


def kinova() -> tuple[Arm, Log, Log]:
    folder = DATA / "kinova_gen3_dynamapp"
    gain = [9.13] * 4 + [5.852] * 3
    arm = Arm.from_urdf(folder / "gen3.urdf", repair_inertia=True, effort=Effort.current(gain))
    columns = ColumnMap.named("kinova_gen3")
    names = ("opti_traj_testing1", "RunTrajectory1")
    first, second = (Log.open(folder / f"{name}.csv.gz", columns) for name in names)
    return arm, first, second


def relative(measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    return 100 * np.linalg.norm(measured - predicted, axis=0) / np.linalg.norm(measured, axis=0)


def window(log: Log) -> tuple[float, float]:
    seconds = log.seconds
    return float(seconds[700]), float(seconds[4200])


def authors(arm: Arm, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Torque by the authors' gains and predicted by their parameters, both in N m by their gains."""
    text = (UR / "UR10E_parameters.txt").read_text()

    def numbers(name: str) -> np.ndarray:
        found = re.search(rf"{name}\s*=\s*\[([^\]]*)\]", text)
        assert found is not None
        return np.array(found[1].split(), dtype=float)

    gain, rotors, friction, links = (numbers(k) for k in ("drvGains", "pi_drvs", "pi_frcn", "pi_rgd"))
    phi = np.concatenate([np.r_[p[9], p[6:9], p[:6]] for p in links.reshape(6, 10)])
    assert len(LINK_TERMS) == 10
    data = prepare(log, cutoff=5.0)
    viscous, coulomb, offset = friction.reshape(6, 3).T
    torque = data.reduce(
        lambda s: (
            arm.regressor(s.q, s.dq, s.ddq) @ phi
            + rotors * s.ddq
            + coulomb * np.sign(s.dq)
            + viscous * s.dq
            + offset
        )
    )
    inside = (data.time >= window(log)[0]) & (data.time <= window(log)[1])
    return (data.effort * gain)[inside], torque[inside]


def report_ur10e() -> None:
    arm, free, _, log = ur10e()
    measured, predicted = authors(arm, log)
    print("UR10e authors      %", relative(measured, predicted), "overall, in their N m",
          f"{np.sqrt(np.mean((measured - predicted) ** 2)):.3f}, in true N m",
          f"{np.sqrt(np.mean(((measured - predicted) * GAIN / authors_gain()) ** 2)):.3f}")  # fmt: skip
    for method in ("consistent", "irls", "wls", "ols"):
        for friction in ("coulomb", "stribeck", "load", "stribeck+load"):
            if method != "consistent" and friction != "stribeck+load":
                continue
            start = time.perf_counter()
            found = fit(arm, free, friction=friction, method=method)
            took = time.perf_counter() - start
            show_prediction(f"UR10e {method} {friction}", found, log, took)
    found = fit(arm, free)
    show_card(found, log)
    for k, name in enumerate(FREE):
        part = fit(arm, free[k], cross_validate=False)
        print(f"UR10e time, {name} ({free[k].duration:.0f} s): least squares {part.seconds[0]:.2f} s, "
              f"consistent {part.seconds[1]:.2f} s")  # fmt: skip


def authors_gain() -> np.ndarray:
    return np.array([10.0, 10.6956, 8.4566, 9.0029, 9.4800, 10.1232])


def show_prediction(what: str, found: Fit, log: Log, took: float) -> None:
    p = found.predict(log)
    inside = (p.time >= window(log)[0]) & (p.time <= window(log)[1])
    error = (p.measured - p.predicted)[inside]
    print(f"{what:<32} %", relative(p.measured[inside], p.predicted[inside]),
          f"overall {np.sqrt(np.mean(error**2)):.3f} N m; held out {100 * found.held_out.relative_overall:.2f} %; "
          f"{took:.2f} s")  # fmt: skip


def show_card(found: Fit, log: Log) -> None:
    """The identified Arm alone: its friction has a smooth sign without memory."""
    data = prepare(log, cutoff=found.cutoff)
    arm = found.arm

    def torque(s):
        rigid = arm.inverse_dynamics(s.q, s.dq, s.ddq)
        inner = rigid - s.ddq * [j.rotor_inertia for j in arm.joints]
        sign = np.tanh(s.dq / [j.friction.sign_velocity for j in arm.joints])
        return (
            rigid + arm.friction_torque(s.dq) + [j.friction.load for j in arm.joints] * np.abs(inner) * sign
        )

    predicted = data.reduce(torque)
    measured = data.effort * arm.effort.gain(arm.n)
    inside = (data.time >= window(log)[0]) & (data.time <= window(log)[1])
    error = (measured - predicted)[inside]
    print(f"{'UR10e the arm card alone':<32} %", relative(measured[inside], predicted[inside]),
          f"overall {np.sqrt(np.mean(error**2)):.3f} N m")  # fmt: skip


def report_gains() -> None:
    arm, free, loaded, _ = ur10e()
    for what, without, carrying in (
        ("31 pair", free[:1], loaded[:1]),
        ("50 s pair", free[3:], loaded[1:]),
        ("all free + 31 load", free, loaded[:1]),
        ("all free + 50 s load", free, loaded[1:]),
        ("all free + both loads", free, loaded),
    ):
        found = fit_gains(arm, without, carrying, KnownLoad(MASS))
        print(f"UR10e gains, {what:<22} {found.gain} error % {100 * (found.gain / GAIN - 1)} "
              f"std % {100 * found.std / found.gain}")  # fmt: skip


def report_load() -> None:
    arm, free, loaded, _ = ur10e()
    found = fit(arm, free)
    for name, log in zip(LOADED, loaded, strict=True):
        for parameters in (10, 4):
            e = estimate_load(found, log, parameters=parameters)
            print(f"load {name}, {parameters} parameters: {e.mass:.3f} kg ({100 * (e.mass / MASS - 1):+.2f} %), "
                  f"std {e.mass_std:.3f}, CoM {e.com}")  # fmt: skip
    rng = np.random.default_rng(0)
    for seconds in (4.0, 8.0, 16.0, 20.0):
        errors, z = [], []
        for log in loaded:
            data = prepare(log, cutoff=found.cutoff)
            problem = LoadProblem(found, Builder(arm, data, data.effort * GAIN))
            known = data.time[problem.problem.known.all(axis=1)][0]
            for start in rng.uniform(known, data.time[-1] - seconds, 100):
                rows = np.flatnonzero((data.time >= start) & (data.time < start + seconds))
                e = problem.solve(rows)
                errors.append(100 * (e.mass / MASS - 1))
                z.append((e.mass - MASS) / e.mass_std)
        a, b = np.abs(errors), np.abs(z)
        print(f"load, 200 random windows of {seconds:g} s: RMS error {np.sqrt(np.mean(a**2)):.2f} %, largest "
              f"{a.max():.2f} %, within 4 % {np.mean(a < 4):.0%}; 95 % interval holds the truth "
              f"{np.mean(b < 1.96):.1%}, RMS of error/std {np.sqrt(np.mean(b**2)):.2f}")  # fmt: skip
    for k, name in enumerate(FREE):
        part = fit(arm, free[:k] + free[k + 1 :])
        e = estimate_load(part, free[k])
        print(
            f"false mass on {name}, fitted on the other three: {1e3 * e.mass:+.0f} g, std {1e3 * e.mass_std:.0f} g"
        )


def report_tx40() -> None:
    arm, log = tx40()
    coupling = [Coupling((4, 5))]
    third = len(log) * 2 // 3
    for friction in ("coulomb", "stribeck", "load", "stribeck+load"):
        for method in ("consistent", "irls", "wls"):
            found = fit(arm, log, friction=friction, couplings=coupling, method=method)
            part = fit(arm, log[:third], friction=friction, couplings=coupling, method=method,
                       validate_on=log[third:])  # fmt: skip
            values = {e.name: e.value for e in found.parameters}
            level = np.array([values[f"{j.name}.coulomb"] for j in arm.joints])
            print(f"TX40 {friction} {method} {found.cutoff:.0f} Hz: residual "
                  f"{100 * found.residuals.relative_overall:.2f} %, 2/3 -> 1/3 "
                  f"{100 * part.held_out.relative_overall:.2f} %, Coulomb against published % "
                  f"{100 * (level / TX40_COULOMB - 1)}, {found.seconds[1]:.2f} s")  # fmt: skip


def report_kuka() -> None:
    arm, (first, second) = kuka()
    for friction in ("coulomb", "stribeck", "load", "stribeck+load"):
        for method in ("consistent", "irls", "wls", "ols"):
            found = fit(arm, first, friction=friction, method=method, validate_on=second)
            print(f"KUKA {friction} {method}: m1 -> m2 {100 * found.held_out.relative_overall:.2f} %, "
                  f"{found.held_out.rms} N m, {found.seconds[1]:.2f} s")  # fmt: skip


def report_kinova() -> None:
    arm, first, second = kinova()
    for friction in ("coulomb", "stribeck", "load", "stribeck+load"):
        found = fit_transmission(arm, first, reference="torque_sensor", friction=friction)
        print(f"Kinova {friction}: own data {found.residuals.rms}, other file {found.test(second).rms} N m, "
              f"reversing {found.reverses.astype(int)} (joint 1's sensor reads 0 in the other file)")  # fmt: skip


def pendulum(mass: float) -> Arm:
    """The bam project's pendulum: a point at 0.1 m, hanging at q = 0."""
    joint = Joint(
        name="joint_1", link="pendulum", kind="revolute", T_parent_joint=np.eye(4), axis=np.array([0.0, 1.0, 0.0]),
        mass=mass, com=np.array([0.0, 0.0, -0.1]), inertia=1e-6 * np.eye(3),
    )  # fmt: skip
    return Arm(name="pendulum", joints=(joint,), effort=Effort.undeclared())


def report_xl330() -> None:
    files = sorted((DATA / "xl330_bam").glob("*.json"))
    logs = [read_bam(path) for path in files]
    for k, log in enumerate(logs):
        drive = fit_bus_drive(pendulum(0.49), logs[:k] + logs[k + 1 :])
        torque, data = drive.load_torque(log)
        per_kilogram = data.reduce(lambda s: pendulum(1.0).inverse_dynamics(s.q, s.dq, s.ddq))[:, 0]
        slow = 0.01 * np.abs(data.dq).max()
        moving = data.reduce(lambda s, v=slow: np.square(np.tanh(s.dq / v)))[:, 0].clip(0.0, 1.0)  # type: ignore[misc]
        mass = float((moving * per_kilogram) @ torque / ((moving * per_kilogram) @ per_kilogram))
        print(f"XL330 kp {log.meta['kp']} {log.meta['trajectory']}: fitted on the other six "
              f"(R/k_t^2 {drive.heat:.1f} W/(N m)^2), mass {mass:.3f} kg "
              f"({100 * (mass / 0.49 - 1):+.1f} %)")  # fmt: skip


def report_cutoff() -> None:
    """How much the default cutoff, prior and friction grid matter: held-out figures at a fixed 5 Hz."""
    arm, free, _, log = ur10e()
    for cutoff in (2.5, 5.0, 10.0):
        show_prediction(f"UR10e cutoff {cutoff:g} Hz", fit(arm, free, cutoff=cutoff), log, 0.0)
    for prior in (0.1, 1.0, 10.0):
        show_prediction(f"UR10e prior {prior:g}", fit(arm, free, prior=prior), log, 0.0)
    arm, (first, second) = kuka()
    for prior in (0.01, 0.1, 1.0, 10.0):
        found = fit(arm, first, prior=prior, validate_on=second)
        print(f"KUKA prior {prior:g}: m1 -> m2 {100 * found.held_out.relative_overall:.2f} %")
    arm, log = tx40()
    third = len(log) * 2 // 3
    for cutoff in (5.0, 10.0, 20.0):
        for prior in (0.1, 1.0, 10.0):
            found = fit(arm, log[:third], couplings=[Coupling((4, 5))], cutoff=cutoff, prior=prior,
                        validate_on=log[third:])  # fmt: skip
            print(f"TX40 cutoff {cutoff:g} Hz, prior {prior:g}: 2/3 -> 1/3 "
                  f"{100 * found.held_out.relative_overall:.2f} %")  # fmt: skip


REPORTS = {
    "ur10e": report_ur10e,
    "gains": report_gains,
    "load": report_load,
    "tx40": report_tx40,
    "kuka": report_kuka,
    "kinova": report_kinova,
    "xl330": report_xl330,
    "cutoff": report_cutoff,
}

if __name__ == "__main__":
    for name in sys.argv[1:] or REPORTS:
        REPORTS[name]()
