"""Identification, gains and loads on recordings of real robots, the rivals on the same files beside.

Every fit uses the defaults of :mod:`palpate.identify` unless the row says otherwise; nothing is tuned to a file. The
recordings are those that :data:`palpate.data.VARIABLE` names, or of ``../shared/data`` beside a checkout.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import data as recordings
from ..arm import Arm, Array, Effort, Joint
from ..errors import LogError
from ..identify import (
    Coupling,
    Fit,
    FrictionModel,
    KnownLoad,
    Residuals,
    estimate_load,
    fit,
    fit_bus_drive,
    fit_gains,
    fit_transmission,
    prepare,
)
from ..identify.load import LoadProblem
from ..identify.regress import Builder
from ..logs import ColumnMap, Log, read_bam, read_tx40
from ..logs.repair import BoolArray
from ..weigh import weigh_log
from . import Progress, Row, _rivals, lara8
from ._bench import INTERVAL, Work
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GAIN = np.array([11.976, 11.976, 9.839, 10.763, 10.763, 10.763])
"""of the UR10e's drives: controller's torque over its current at rest [N m/A]"""
MASS = 2.805
"""known load of the UR10e [kg]"""
FREE = (
    "ur-20_01_31-unload",
    "ur-20_02_10-30sec_12harm",
    "ur-20_02_12-40sec_12harm",
    "ur-20_02_19_14harm50sec",
)
LOADED = ("ur-20_01_31-load", "ur-20_02_19_14harm50secLoad")
POINTS = (700, 4200)
"""rows of the UR10e's point-to-point log that are judged"""
RESIDUAL = (12.0, 5.0, 5.0, 8.0, 16.0, 50.0)
"""required relative residual of each of its joints [%]"""
TX40_COULOMB = (7.14, 8.26, 6.34, 2.48, 3.03, 0.282)
"""published Coulomb friction of the TX40 [N m]"""
PENDULUM = 0.49
"""mass on the XL330 [kg]"""
KINOVA_ALIKE = ((0, 1, 2, 3), (4, 5, 6))
"""the Gen3 has four large actuators and three small ones"""
WINDOWS = 100
"""random windows per log and length"""


def place(folder: str) -> Path:
    """The folder of a data set.

    Raises:
        LogError: it is not on this machine.
    """
    found = recordings.local(folder)
    if found is not None:
        return found
    raise LogError(
        f"no recordings {folder!r} on this machine: {recordings.VARIABLE} names the folder with them"
    )


def ur10e() -> tuple[Arm, list[Log], list[Log], Log]:
    """Arm, free logs, loaded logs, point-to-point log."""
    folder = place("ur10e_innopolis")
    arm = Arm.from_urdf(folder / "ur10e.urdf", tip="tool0", effort=Effort.current(GAIN))
    columns = ColumnMap.named("ur10e")
    free, loaded = (
        [Log.open(folder / "identification_data" / f"{name}.csv", columns) for name in names]
        for names in (FREE, LOADED)
    )
    return arm, free, loaded, Log.open(folder / "validation_data" / "ur-20_01_17-ptp_10_points.csv", columns)


def tx40() -> tuple[Arm, Log]:
    """Arm and its one log, at the joint side."""
    folder = place("staubli_tx40")
    arm = Arm.from_urdf(folder / "tx40_mdh_modified.urdf", repair_inertia=True, effort=Effort.torque())
    return arm, read_tx40(folder / "pos_read_data.csv.gz", folder / "curr_data.csv.gz")


def kuka() -> tuple[Arm, Log, Log]:
    """Arm and the two runs of one trajectory."""
    folder = place("kuka_lwr4_iit")
    # the file gives the first joint two origins; the pedestal's height is of no matter to the dynamics
    text = (folder / "kuka_lwr4.urdf").read_text().replace('<origin rpy="0 0 0" xyz="-0.25 0 1"/>\n', "", 1)
    arm = Arm.from_urdf(text, repair_inertia=True, effort=Effort.torque())
    columns = ColumnMap.named("kuka_lwr4")
    first, second = (Log.open(folder / f"measurements_{k}.npz", columns) for k in (1, 2))
    return arm, first, second


def kinova() -> tuple[Arm, Log, Log]:
    """Arm, the log to fit, the log to test."""
    folder = place("kinova_gen3_dynamapp")
    effort = Effort.current([9.13] * 4 + [5.852] * 3)
    arm = Arm.from_urdf(folder / "gen3.urdf", repair_inertia=True, effort=effort)
    columns = ColumnMap.named("kinova_gen3")
    names = ("opti_traj_testing1", "RunTrajectory1")
    first, second = (Log.open(folder / f"{name}.csv.gz", columns) for name in names)
    return arm, first, second


def pendulum(mass: float) -> Arm:
    """The XL330's load: a point at 0.1 m, hanging at q = 0."""
    joint = Joint(
        name="joint_1", link="pendulum", kind="revolute", T_parent_joint=np.eye(4), axis=np.array([0.0, 1.0, 0.0]),
        mass=mass, com=np.array([0.0, 0.0, -0.1]), inertia=1e-6 * np.eye(3),
    )  # fmt: skip
    return Arm(name="pendulum", joints=(joint,), effort=Effort.undeclared())


# --- measuring --------------------------------------------------------------------------------------------------------


def judged(time_s: Array, log: Log) -> BoolArray:
    """Which of the times lie in the point-to-point log's judged rows."""
    first, last = (float(log.seconds[k]) for k in POINTS)
    inside: BoolArray = (time_s >= first) & (time_s <= last)
    return inside


def percent(measured: Array, predicted: Array) -> Array:
    """|measured - predicted| / |measured| of every column [%]."""
    found: Array = 100.0 * np.linalg.norm(measured - predicted, axis=0) / np.linalg.norm(measured, axis=0)
    return found


def listed(values: Array | Sequence[float], digits: int = 1) -> str:
    """Numbers in a row."""
    return " ".join(f"{v:.{digits}f}" for v in values)


def within(
    what: str, required: Sequence[float], ours: Array, unit: str, note: str = "", digits: int = 1
) -> Row:
    """Every joint's number must not exceed its own bar."""
    bars = " ".join(f"{v:g}" for v in required)
    return Row(
        what,
        f"<= {bars}",
        listed(ours, digits),
        None,
        bool(np.all(np.asarray(ours) <= required)),
        unit,
        note,
    )


def authors(log: Log, arm: Arm) -> float:
    """RMS of the error of the UR10e authors' own parameters in the judged rows [N m by their gains]."""
    text = (place("ur10e_innopolis") / "UR10E_parameters.txt").read_text()

    def numbers(name: str) -> Array:
        found = re.search(rf"{name}\s*=\s*\[([^\]]*)\]", text)
        if found is None:
            raise LogError(f"UR10E_parameters.txt has no {name}")
        return np.array(found[1].split(), dtype=np.float64)

    gain, rotors, friction, links = (numbers(k) for k in ("drvGains", "pi_drvs", "pi_frcn", "pi_rgd"))
    phi = np.concatenate([np.r_[p[9], p[6:9], p[:6]] for p in links.reshape(6, 10)])
    viscous, coulomb, offset = friction.reshape(6, 3).T
    data = prepare(log, cutoff=5.0)
    torque = data.reduce(
        lambda s: (
            arm.regressor(s.q, s.dq, s.ddq) @ phi
            + rotors * s.ddq
            + coulomb * np.sign(s.dq)
            + viscous * s.dq
            + offset
        )
    )
    inside = judged(data.time, log)
    return float(np.sqrt(np.mean(np.square((data.effort * gain - torque)[inside]))))


def predicted(found: Fit, log: Log) -> tuple[Array, float]:
    """Relative residual of each joint [%] and RMS over all [N m] in the judged rows."""
    p = found.predict(log)
    inside = judged(p.time, log)
    measured, guess = p.measured[inside], p.predicted[inside]
    return percent(measured, guess), float(np.sqrt(np.mean(np.square(measured - guess))))


def _ur10e() -> list[Row]:
    arm, free, _, log = ur10e()
    found = fit(arm, free)
    joints, overall = predicted(found, log)
    theirs = authors(log, arm)
    least, _ = predicted(fit(arm, free, method="irls", cross_validate=False), log)
    return [
        within("UR10e, four free logs -> point-to-point motion: relative residual, joints 1 to 6", RESIDUAL, joints,
               "%", f"overall {overall:.3f} N m; least squares {listed(least)} %"),
        Row("UR10e: its overall RMS against the authors' parameters", "<= -10", 100.0 * (overall / theirs - 1.0), None,
            overall <= 0.9 * theirs, "%", f"authors {theirs:.3f} N m, by their lower gains"),
    ]  # fmt: skip


def _gains() -> list[Row]:
    arm, free, loaded, _ = ur10e()
    pairs = (("first pair", free[:1], loaded[:1]), ("second pair", free[3:], loaded[1:]))
    rows = []
    for what, without, carrying in pairs:
        found = fit_gains(arm, without, carrying, KnownLoad(MASS))
        error = 100.0 * (found.gain / GAIN - 1.0)
        rows.append(
            at_most(
                f"UR10e gains from a known load, {what}: largest error",
                4.0,
                float(np.abs(error).max()),
                "%",
                f"joints {listed(error)} %; it states deviations of {listed(100.0 * found.std / found.gain)} %",
            )
        )
    everything = fit_gains(arm, free, loaded, KnownLoad(MASS))
    error = 100.0 * (everything.gain / GAIN - 1.0)
    rows.append(
        told(
            "UR10e gains from all four free logs and both loaded ones: largest error",
            float(np.abs(error).max()),
            "%",
            f"joints {listed(error)} %: more data do not mend the wrist",
            beside="<= 4",
        )
    )
    nominal = fit(arm, free)
    for what, joints in (("joints 1 to 3", (0, 1, 2)), ("joints 4 to 6", (3, 4, 5))):
        masses = [by_part(nominal, log, joints) for log in loaded]
        error = listed([100.0 * (m / MASS - 1.0) for m in masses])
        rows.append(
            Row(f"UR10e known load, weighed by {what} alone with the controller's gains", MASS, listed(masses, 3),
                None, None, "kg", f"{error} %: so far these gains and the known mass contradict each other")
        )  # fmt: skip
    return rows


def by_part(found: Fit, log: Log, joints: Sequence[int]) -> float:
    """Mass that some joints' torques alone would give [kg]: the others' errors count as endless."""
    others = np.isin(np.arange(found.arm.n), joints, invert=True)
    return estimate_load(replace(found, error_std=found.error_std * np.where(others, 1e3, 1.0)), log).mass


def _load() -> list[Row]:
    arm, free, loaded, _ = ur10e()
    found = fit(arm, free)
    rows = []
    for name, log in zip(LOADED, loaded, strict=True):
        e = estimate_load(found, log)
        rows.append(near(f"UR10e load, {name}", MASS, e.mass, 0.01 * MASS, "kg",
                         f"{100.0 * (e.mass / MASS - 1.0):+.2f} %, std {1e3 * e.mass_std:.0f} g"))  # fmt: skip
    rng = np.random.default_rng(0)
    problems = []
    for log in loaded:
        data = prepare(log, cutoff=found.cutoff)
        problems.append((data, LoadProblem(found, Builder(arm, data, data.effort * GAIN))))
    held, worst, counted = [], {}, {}
    for seconds in (4.0, 8.0, 16.0):
        errors, inside = [], []
        for data, problem in problems:
            known = float(data.time[problem.problem.known.all(axis=1)][0])
            for start in rng.uniform(known, data.time[-1] - seconds, WINDOWS):
                e = problem.solve(np.flatnonzero((data.time >= start) & (data.time < start + seconds)))
                errors.append(abs(e.mass / MASS - 1.0))
                inside.append(abs(e.mass - MASS) <= INTERVAL * e.mass_std)
        worst[seconds], counted[seconds] = 100.0 * max(errors), 100.0 * float(np.mean(inside))
        held += inside
    rows.append(at_most(f"UR10e load in any of {2 * WINDOWS} random windows of 8 s: largest error", 4.0, worst[8.0],
                        "%", f"4 s: {worst[4.0]:.1f} %, 16 s: {worst[16.0]:.1f} %"))  # fmt: skip
    share = 100.0 * float(np.mean(held))
    rows.append(Row("UR10e load: 95 % intervals of the windows of 4, 8 and 16 s that hold the truth", "90 to 99", share,
                    None, 90.0 <= share <= 99.0, "%", f"{listed(list(counted.values()))} %"))  # fmt: skip
    false = [1e3 * estimate_load(fit(arm, free[:k] + free[k + 1 :]), log).mass for k, log in enumerate(free)]
    rows.append(at_most("UR10e false mass, each free log by a fit of the other three: largest", 30.0,
                        max(abs(m) for m in false), "g", f"{listed(false, 0)} g"))  # fmt: skip
    return rows


def _lara8() -> list[Row]:
    arm = lara8.lara8_arm()
    log = lara8.open_log(lara8.LOADED)
    weighed, truth = weigh_log(log, arm), lara8.wrist_sensor(arm, log)
    alone = lara8.residual(log)
    per_kilogram, jacobian = lara8.per_kilogram(arm, log), arm.jacobian(log.position)[:, :3]
    plain = np.linalg.lstsq
    force = np.array([plain(J.T, t, rcond=None)[0] for J, t in zip(jacobian, alone, strict=True)])
    held = weighed.mass * arm.gravity

    def rms(error: Array) -> float:
        return float(np.sqrt(np.mean(np.square(error))))

    torques = [rms(alone - truth.torque), rms(per_kilogram * weighed.mass - truth.torque)]
    forces = [rms(f - truth.force) * np.sqrt(3.0) for f in (force, held)]
    note = (
        "the load's torques and weight, against model minus current joint by joint; a load is all that acts"
    )
    return [
        near("LARA8 load", lara8.MASS, weighed.mass, 0.04 * lara8.MASS, "kg",
             f"{100.0 * (weighed.mass / lara8.MASS - 1.0):+.1f} %, standard deviation {weighed.mass_std:.2f} kg; "
             "`palpate reproduce lara8` tells why: joint 3's current shows a third more than the load"),
        *(
            Row(f"LARA8 {what}: RMS against the wrist sensor, change by palpate", "<= -25", 100.0 * (b / a - 1.0), None,
                b <= 0.75 * a, "%", f"current only {a:.2f} {unit}, ours {b:.2f} {unit}; {note}")
            for what, unit, (a, b) in (("external joint torque", "N m", torques), ("force", "N", forces))
        ),
    ]  # fmt: skip


def chosen_friction(arm: Arm, log: Log) -> str:
    """The friction that predicts the ends of the log best from the rest of it: two thirds, and the other way round."""
    third = len(log) // 3

    def held_out(name: str) -> float:
        folds = ((log[: 2 * third], log[2 * third :]), (log[third:], log[:third]))
        errors = [
            fit_transmission(arm, rest, reference="torque_sensor", friction=name, alike=KINOVA_ALIKE).test(
                part
            )
            for rest, part in folds
        ]
        return float(sum(e.overall**2 for e in errors))

    return min(("coulomb", "stribeck", "load", "stribeck+load"), key=held_out)


def _kinova() -> list[Row]:
    arm, first, second = kinova()
    friction = chosen_friction(arm, first)
    found = fit_transmission(arm, first, reference="torque_sensor", friction=friction, alike=KINOVA_ALIKE)
    default = fit_transmission(arm, first, reference="torque_sensor")
    # joint 1's sensor reads 0 in the second file
    seen = np.flatnonzero(found.reverses)[1:]
    ours, plain = found.test(second).rms, default.test(second).rms
    itself = fit_transmission(arm, second, reference="torque_sensor", friction=friction, alike=KINOVA_ALIKE)
    offset = np.array(
        [[e.value for e in f.parameters if e.name.endswith(".offset")] for f in (found, itself)]
    )
    return [
        within(f"Kinova current -> joint torque sensor in another file, joints {', '.join(str(j + 1) for j in seen)}",
               (0.5,) * len(seen), ours[seen], "N m",
               f"friction {friction}, chosen within the first file; joints of one actuator size share a rotor inertia. "
               f"{listed(plain[seen], 2)} N m with the defaults; joints 2 and 5 never reverse in the first file: "
               f"{listed(ours[[1, 4]], 2)} N m. The other file is 2 to 6 K warmer", 2),
        told("Kinova: the same, fitted on the tested file itself", listed(itself.residuals.rms[seen], 2), "N m",
             "what the model leaves at best; between the files the offset of current and sensor changes by "
             f"{listed((offset[1] - offset[0])[seen], 2)} N m", beside="<= 0.5"),
    ]  # fmt: skip


def moving(found: Fit, log: Log) -> float:
    """Relative residual over all joints in the rows faster than figaroh's thresholds [%]."""
    p = found.predict(log)
    kept = (np.abs(p.dq) >= _rivals.SLOW) & p.known
    error = (p.measured - p.predicted)[kept]
    return 100.0 * float(np.linalg.norm(error) / np.linalg.norm(p.measured[kept]))


def _tx40() -> list[Row]:
    arm, log = tx40()
    coupling = [Coupling((4, 5))]
    two_thirds = len(log) * 2 // 3
    whole = fit(arm, log, couplings=coupling)
    part = fit(arm, log[:two_thirds], couplings=coupling, validate_on=log[two_thirds:])
    plain = fit(arm, log, friction="coulomb", couplings=coupling, method="wls", cross_validate=False)
    values = {e.name: e.value for e in plain.parameters}
    level = np.array([values[f"{j.name}.coulomb"] for j in arm.joints])
    error = 100.0 * (level / np.array(TX40_COULOMB) - 1.0)
    assert part.held_out is not None
    return [
        at_most("TX40: residual", 6.4, 100.0 * whole.residuals.relative_overall, "%",
                f"{moving(whole, log):.1f} % over the rows that figaroh keeps"),
        at_most("TX40: first two thirds -> last third", 12.0, 100.0 * part.held_out.relative_overall, "%",
                f"{moving(part, log[two_thirds:]):.1f} % over the rows that figaroh keeps"),
        at_most("TX40: Coulomb friction of joints 1 to 5 against the published, largest", 5.0,
                float(np.abs(error[:5]).max()), "%",
                f"{listed(error)} %; weighted least squares with the published friction model, joint 6 has 0.28 N m"),
    ]  # fmt: skip


def chosen_within(arm: Arm, log: Log) -> tuple[FrictionModel, float, float, float]:
    """Springs and weight of the prior by how thirds of the log are predicted from one another.

    A joint gets a spring if all joints' springs together make its held-out error less, and its own is more than two
    standard deviations. The prior is the one of a tenth, one and ten that then leaves the least held-out error.

    Returns:
        friction, weight of the prior, held-out error within the log with these and with the defaults [%].
    """
    model = FrictionModel.named("stribeck+load")

    def held_out(found: Fit) -> Residuals:
        assert found.held_out is not None
        return found.held_out

    plain, everywhere = fit(arm, log), fit(arm, log, friction=replace(model, springs=tuple(range(arm.n))))
    stiffness = [e for e in everywhere.parameters if e.name.endswith(".stiffness")]
    better = held_out(everywhere).rms < held_out(plain).rms
    springs = tuple(j for j, e in enumerate(stiffness) if better[j] and e.value > 2.0 * e.std)
    best = replace(model, springs=springs)
    tried = {
        prior: held_out(fit(arm, log, friction=best, prior=prior)).relative_overall
        for prior in (0.1, 1.0, 10.0)
    }
    prior = min(tried, key=lambda p: tried[p])
    return best, prior, 100.0 * tried[prior], 100.0 * held_out(plain).relative_overall


def _kuka() -> list[Row]:
    arm, first, second = kuka()
    model, prior, chosen, plain = chosen_within(arm, first)
    joints = ", ".join(str(j + 1) for j in model.springs) or "none"
    found = fit(arm, first, friction=model, prior=prior, validate_on=second)
    assert found.held_out is not None
    rows = [
        at_most("KUKA LWR, first run -> second run, physically consistent", 2.0,
                100.0 * found.held_out.relative_overall, "%",
                f"harness's spring at joint {joints}, prior weight {prior:g}, chosen within the first run: thirds of "
                f"it from one another {chosen:.2f} %, with the defaults {plain:.2f} %")
    ]  # fmt: skip
    for what, method in (("physically consistent", "consistent"), ("weighted least squares", "wls")):
        other = fit(arm, first, method=method, validate_on=second)  # type: ignore[arg-type]
        assert other.held_out is not None
        rows.append(told(f"KUKA LWR, {what}, defaults", 100.0 * other.held_out.relative_overall, "%"))
    return rows


def _xl330() -> list[Row]:
    logs = [read_bam(path) for path in sorted(place("xl330_bam").glob("*.json"))]
    error = []
    for k, log in enumerate(logs):
        drive = fit_bus_drive(pendulum(PENDULUM), logs[:k] + logs[k + 1 :])
        error.append(100.0 * (drive.weigh(pendulum(1.0), log) / PENDULUM - 1.0))
    return [
        at_most("XL330, 0.49 kg from its supply current, each log by a fit of the others: largest error", 15.0,
                max(abs(e) for e in error), "%", f"{listed(error)} %"),
    ]  # fmt: skip


def _time() -> list[Row]:
    arm, free, _, judge = ur10e()
    log = free[3]
    note = f"best of 3; load {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores, one of them used"
    rows = []
    for name, logged_arm, logged in (("UR10e", arm, log), ("KUKA LWR", *kuka()[:2])):
        fit(logged_arm, logged, cross_validate=False)  # imports and pages in what later fits find there
        times = [fit(logged_arm, logged, cross_validate=False).seconds for _ in range(3)]
        for k, (what, limit) in enumerate((("least squares", 1.0), ("physically consistent", 5.0))):
            what = f"time to identify {name}, {logged_arm.n} joints, from {logged.duration:.0f} s, {what}"
            rows.append(at_most(what, limit, min(t[k] for t in times), "s", note))
    for name in ("pinocchio", "figaroh"):
        what = f"rival: time for the same log, {name}"
        try:
            urdf = place("ur10e_innopolis") / "ur10e.urdf"
            runs = [_rivals.identify(name, urdf, [log], judge, GAIN).seconds for _ in range(2)]
        except _rivals.NotHere as error:
            rows.append(Row(what, None, "not measured", None, None, "s", str(error)))
        else:
            rows.append(
                told(
                    what,
                    min(runs),
                    "s",
                    "best of 2; one plain or weighted least squares, no search of friction",
                )
            )
    return rows


def _rival(name: str) -> Callable[[], list[Row]]:
    def ur() -> list[Row]:
        _, free, _, log = ur10e()
        theirs = _rivals.identify(name, place("ur10e_innopolis") / "ur10e.urdf", free, log, GAIN)
        inside = judged(theirs.time, log)
        measured, guess = theirs.measured[inside], theirs.predicted[inside]
        overall = float(np.sqrt(np.mean(np.square(measured - guess))))
        return [
            Row(f"rival: {theirs.name}, UR10e, as above", None, listed(percent(measured, guess)), None, None, "%",
                f"overall {overall:.3f} N m; fit of {theirs.rows} rows in {theirs.seconds:.1f} s; {theirs.note}"),
        ]  # fmt: skip

    return ur


def _rival_tx40() -> list[Row]:
    folder = place("staubli_tx40")
    theirs = _rivals.figaroh_tx40(folder)
    return [
        told("rival: figaroh 1.0.2, TX40 by its own example, residual", 100.0 * theirs.residual, "%",
             f"{theirs.seconds:.1f} s; without the rows near zero velocity, which it drops"),
        told("rival: figaroh 1.0.2, TX40, first two thirds -> last third", 100.0 * theirs.held_out, "%"),
    ]  # fmt: skip


_JOBS: Mapping[str, Callable[[], list[Row]]] = {
    "ur10e": _ur10e,
    "gains": _gains,
    "load": _load,
    "lara8": _lara8,
    "kinova": _kinova,
    "tx40": _tx40,
    "kuka": _kuka,
    "xl330": _xl330,
    "time": _time,
    "rival-pinocchio": _rival("pinocchio"),
    "rival-figaroh": _rival("figaroh"),
    "rival-sysid": _rival("sysid"),
    "rival-figaroh-tx40": _rival_tx40,
}
_QUICK = ("ur10e", "lara8", "kinova", "xl330")
"""jobs of a few seconds"""


def measure(job: str) -> list[Row]:
    """The rows of one job; one row with the reason where its recordings or its rival are not on this machine."""
    try:
        return _JOBS[job]()
    except _rivals.NotHere as error:
        return [Row(job, None, "not measured", None, None, "", str(error))]
    except LogError as error:
        if "on this machine" not in str(error):
            raise
        return [Row(job, None, "not measured", None, None, "", str(error))]


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; the time is taken first and alone, in a process that has loaded no rival yet."""
    jobs = list(_QUICK if quick else _JOBS)
    begin = time.perf_counter()
    alone = [] if quick else ["time"]
    with Work(progress, len(jobs)) as work:
        order = [*alone, *(job for job in jobs if job not in alone)]
        results = [*work.map(measure, alone), *work.map(measure, order[len(alone) :])]
    found = dict(zip(order, results, strict=True))
    rows = [row for job in jobs for row in found[job]]
    return rows, {}, [
        f"Measured in {time.perf_counter() - begin:.0f} s. Fits use the defaults of palpate.identify unless a row says "
        "otherwise; frictions, cutoffs, weights and deviations come from the logs of the fit, never from the log that "
        "is judged.",
        "The UR10e's gains are held against those of its controller. With them the wrist alone finds the known load 4 "
        "to 6 % too heavy and shoulder and elbow 2 % too light: the gains found from the load differ from them by just "
        "that, in both pairs of logs, whatever the friction, the cutoff and the weights. The load's centre of mass is "
        "not known, and a change of a drive's scale under load of 1 % moves the gains by several per cent: so the "
        "deviations stated.",
        "The contacts of the UR10e, and the simulated studies, have benches of their own.",
    ]  # fmt: skip
