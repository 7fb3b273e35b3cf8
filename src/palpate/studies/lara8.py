"""A real arm weighs: a NEURA LARA 8 holds 5.26 kg below a wrist force/torque sensor that tells the truth.

The log (A. Lucious, see :mod:`palpate.data`) holds the joint torque that the controller computes from the motor
currents, and the controller's own torque of the bare arm with its friction model. Their difference is the external
torque, so no masses are needed: the arm is its DH table. The load is told from friction and drive gains by their sizes
alone, and the interval has to say how badly these are known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import data
from .._core import JointFormula, ModelResidualObserver
from ..arm import Arm, Array, Effort, Friction, Sensing
from ..logs import ColumnMap, Log, SignalColumns
from ..pipeline import Pipeline
from ..weigh import Weighing, weigh_log
from . import Progress, Row, _figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOADED, FREE = "jogging_linear_mass.csv", "jogging_final.csv"
MASS = 5.26
"""below the sensor, from its mean force [kg]"""
TOLERANCE = 0.06
"""required [1]"""
TWO_SIDED_95 = 1.959963984540054
GEAR = (121.0, 121.0, 101.0, 101.0, 101.0, 101.0)
COUNTS = float(1 << 24)
"""of each encoder, motor and load side, per turn"""

_COULOMB = (13.1506, 14.014, 6.52696, 9.48139, 2.50803, 1.59798)
_VISCOUS = (29.57, 50.65, 13.79, 11.45, 3.137, 2.016)
_TORQUE_STD = (2.0, 3.3, 1.4, 1.0, 0.25, 0.3)


def lara8_arm() -> Arm:
    """The LARA 8 from its DH table: kinematics, friction and sensing, no masses.

    The upper arm is 0.60 m long: so the poses that the controller logged are met within 6 um in both logs, at rest and
    in motion. (With 0.48 m, as the table that goes with the data has it, they are off by 0.12 m along the upper arm.)

    Friction is that of the controller's own model, F_c and F_v = row 2 and row 1 x row 4 of
    ``friction_parameters_lara8.json``. The deviations of torque and velocity are those of the arm at rest without load.
    ``torque_gain_std`` = 0.1 is no figure of this arm: it is what a torque computed from the current is worth, where
    nobody has calibrated the drives against a known load.
    """
    half = math.pi / 2
    arm = Arm.from_dh(
        a=(0.0, 0.60, 0.0, 0.0, 0.0, 0.0),
        alpha=(-half, 0.0, half, -half, half, 0.0),
        d=(0.26, 0.0, 0.0, 0.7, 0.0, 0.1735),
        theta0=(0.0, -half, half, 0.0, 0.0, 0.0),
        name="neura_lara8",
        effort=Effort.torque(),
    )
    joints = tuple(
        joint.replace(
            friction=Friction(coulomb=coulomb, viscous=viscous),
            sensing=Sensing(velocity_std=2e-3, torque_std=noise, torque_gain_std=0.1),
        )
        for joint, coulomb, viscous, noise in zip(arm.joints, _COULOMB, _VISCOUS, _TORQUE_STD, strict=True)
    )
    return arm.replace(
        joints=joints,
        provenance={
            "kinematics": "DH table; upper arm 0.60 m by the poses that the controller logged",
            "friction": "friction_parameters_lara8.json of the data set lara8: the controller's own model",
            "noise": "standard deviation at rest without load, jogging_final.csv",
            "torque_gain_std": "10 %: drives that nobody calibrated against a known load",
        },
    )


def open_log(file: str) -> Log:
    """A log of the data set, with both encoders of every joint among its signals.

    Raises:
        LogError: the data set is not on this machine.
    """
    known = ColumnMap.named("lara8")
    encoders = {name: SignalColumns(f"encoder_{name}_{{joint}}", "1") for name in ("loadinc", "motorinc")}
    return Log.open(data.find("lara8", file), replace(known, signals={**known.signals, **encoders}))


@dataclass(frozen=True, slots=True)
class Sensor:
    """What the wrist sensor says."""

    force: Array
    """(N, 3) on the arm, base frame [N]"""
    torque: Array
    """(N, n) it puts on the joints, J^T F [N m]"""

    @property
    def mass(self) -> float:
        """Mean |F| / 9.81 [kg]."""
        return float(np.linalg.norm(self.force, axis=1).mean()) / 9.81


def wrist_sensor(arm: Arm, log: Log) -> Sensor:
    """The sensor's force; its z component has the opposite sign of the tool's z axis.

    Only so does a hanging load give one and the same force in the base frame in every pose.
    """
    in_tool = log.signals["fts_reading"].value[:, :3] * (1.0, 1.0, -1.0)
    force = np.einsum("nij,nj->ni", arm.forward_kinematics(log.position)[:, :3, :3], in_tool)
    return Sensor(force, np.einsum("nij,ni->nj", arm.jacobian(log.position)[:, :3], force))


def per_kilogram(arm: Arm, log: Log) -> Array:
    """(N, n) external torque of 1 kg at the tip, at rest [N m/kg]."""
    return np.einsum("nij,i->nj", arm.jacobian(log.position, arm.grasp)[:, :3], arm.gravity)


def residual(log: Log) -> Array:
    """(N, n) the controller's model torque minus the torque it measured, unfiltered [N m]."""
    assert log.model_torque is not None
    return log.model_torque - log.effort


def torsion(log: Log) -> Array:
    """(N, n) of the gears, motor side minus load side [rad], up to a constant per joint, the same in both logs."""
    load = np.unwrap(log.signals["loadinc"].value, period=COUNTS, axis=0)
    return (log.signals["motorinc"].value / GEAR - load) * (2.0 * math.pi / COUNTS)


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Weigh; two logs of five seconds leave nothing to shorten for `quick`."""
    arm = lara8_arm()
    loaded, free = (weigh_log(open_log(file), arm) for file in (LOADED, FREE))
    progress(1, 1, 0.0)
    truth = wrist_sensor(arm, loaded.log)
    return (
        [
            *_mass_rows(loaded, truth),
            *_truth_rows(truth),
            *_other_rows(arm, loaded),
            *_free_rows(free, wrist_sensor(arm, free.log)),
            *_joint_rows(arm, loaded, truth),
            *_tried_rows(arm, loaded.log, free.log),
        ],
        _figures.drawn(lambda: _draw(arm, loaded, free, truth)),
        [
            "Settings are the defaults of `palpate weigh LOG --arm CARD` for an arm without masses. None was chosen by "
            "looking at the error, which the wrist sensor alone reveals.",
            "In this pose only joints 2 and 3 feel the load, with nearly the same lever, and they disagree: joint 3's "
            "motor currents show a third more torque than the load gives, by twice its Coulomb friction, at rest and "
            "in motion. Whoever weighs by both lands between them; nothing in the currents says which is right.",
            "Tried, and no help: the unloaded log as a tare (its pose, gravity and friction differ); the mean of both "
            "directions of motion (friction cancels, and joint 3 is still off by a quarter); the torsion of the gears "
            "between the two encoders of each joint (it differs by 0.35 mrad between two poses in which joint 2 bears "
            "the same torque, more than half of what the load does to joint 3).",
        ],
    )


def _mass_rows(loaded: Weighing, truth: Sensor) -> list[Row]:
    mass, half = loaded.mass, TWO_SIDED_95 * loaded.mass_std
    return [
        Row(
            "mass by regression over all joints, 5 s",
            MASS,
            mass,
            TOLERANCE * MASS,
            abs(mass - MASS) <= TOLERANCE * MASS,
            "kg",
            f"{100.0 * (mass / MASS - 1.0):+.1f} %; joints 2 and 3 disagree by more than their friction",
        ),
        Row(
            "its 95 % interval contains the wrist sensor's mass",
            f"{truth.mass:.2f}",
            f"{mass - half:.2f} to {mass + half:.2f}",
            None,
            abs(mass - truth.mass) <= half,
            "kg",
            f"status {loaded.status.name}",
        ),
    ]


def _truth_rows(truth: Sensor) -> list[Row]:
    mean, spread = truth.force.mean(axis=0), truth.force.std(axis=0)
    weight = float(np.linalg.norm(truth.force, axis=1).mean())
    return [
        Row(
            "wrist sensor: mean |F|",
            51.62,
            weight,
            0.05,
            abs(weight - 51.62) <= 0.05,
            "N",
            f"{truth.mass:.3f} kg",
        ),
        Row(
            "wrist sensor: mean force in the base frame",
            f"0, 0, {-MASS * 9.81:.1f}",
            ", ".join(f"{f:.1f}" for f in mean),
            None,
            None,
            "N",
            "standard deviation " + ", ".join(f"{s:.1f}" for s in spread),
        ),
    ]


def _other_rows(arm: Arm, loaded: Weighing) -> list[Row]:
    """Other ways to the mass from the same log."""
    log = loaded.log
    levers, torque = per_kilogram(arm, log), residual(log)
    squares = float((levers * torque).sum() / (levers**2).sum())
    formula = published_formula(arm, log)
    weighing = arm.weighing_joint(log.position)
    return [
        Row(
            "plain least squares over all joints",
            MASS,
            squares,
            None,
            None,
            "kg",
            f"{_percent(squares)}, no interval",
        ),
        Row(
            "published joint formula (nearest joint that feels the load), mean over time",
            MASS,
            formula,
            None,
            None,
            "kg",
            _percent(formula),
        ),
        Row(
            "joint that weighing_joint picks",
            None,
            weighing.name,
            None,
            None,
            "",
            f"lever {weighing.lever:.3f} m, sin {weighing.sin_angle:.2f}",
        ),
    ]


def published_formula(arm: Arm, log: Log) -> float:
    """Mean of the joint formula's mass where its gates are open [kg]."""
    payload = Pipeline(arm, observer=ModelResidualObserver(), payload=JointFormula()).run(log).payload
    return float(payload.mass[payload.status == 0].mean())


def _free_rows(free: Weighing, sensor: Sensor) -> list[Row]:
    half = TWO_SIDED_95 * free.mass_std
    return [
        Row(
            "nothing held: false mass",
            0.0,
            free.mass,
            half,
            abs(free.mass) <= half,
            "kg",
            f"tolerance is its own 95 % interval; sensor {sensor.mass:.2f} kg; status {free.status.name}",
        )
    ]


def _joint_rows(arm: Arm, loaded: Weighing, truth: Sensor) -> list[Row]:
    """Mean external torque of each joint against the sensor's, and the mass it would give alone."""
    torque, lever = residual(loaded.log).mean(axis=0), per_kilogram(arm, loaded.log).mean(axis=0)
    expected = truth.torque.mean(axis=0)
    rows = []
    for i, joint in enumerate(arm.joints):
        error = float(torque[i] - expected[i])
        note = f"off by {error:+.1f} N m, {abs(error) / joint.friction.coulomb:.2f} of its Coulomb friction"
        if abs(lever[i]) > 1.0:
            alone = float(torque[i] / lever[i])
            note += f"; alone {alone:.2f} kg ({_percent(alone)})"
        rows.append(
            Row(
                f"{joint.name}: external torque, mean",
                round(float(expected[i]), 3),
                round(float(torque[i]), 3),
                None,
                None,
                "N m",
                note,
            )
        )
    return rows


def _tried_rows(arm: Arm, loaded: Log, free: Log) -> list[Row]:
    """What else the two logs could be used for."""
    levers, torque = per_kilogram(arm, loaded), residual(loaded)
    empty = residual(free)[_still(free)].mean(axis=0)
    tared = float((levers * (torque - empty)).sum() / (levers**2).sum())
    direction = np.sign(loaded.signals["target_joint_velocity"].value)
    both = []
    for i in (1, 2):
        ways = [float((torque[:, i] / levers[:, i])[direction[:, i] == way].mean()) for way in (1.0, -1.0)]
        both.append(0.5 * sum(ways))
    twist = 1e3 * (torsion(loaded)[_still(loaded)].mean(axis=0) - torsion(free)[_still(free)].mean(axis=0))
    assert loaded.model_torque is not None and free.model_torque is not None
    model = loaded.model_torque[_still(loaded)].mean(axis=0) - free.model_torque[_still(free)].mean(axis=0)
    bears = model - MASS * levers[_still(loaded)].mean(axis=0)
    return [
        Row("tried: tare by the unloaded log, least squares", MASS, tared, None, None, "kg", _percent(tared)),
        *(
            Row(
                f"tried: {arm.joint_names[i]} alone, mean of both directions",
                MASS,
                m,
                None,
                None,
                "kg",
                _percent(m),
            )
            for i, m in zip((1, 2), both, strict=True)
        ),
        *(
            Row(
                f"tried: torsion of {arm.joint_names[i]} between the two logs, at rest",
                None,
                float(twist[i]),
                None,
                None,
                "mrad",
                f"for a change of {bears[i]:+.1f} N m",
            )
            for i in (1, 2)
        ),
    ]


def _still(log: Log) -> Any:
    """(N,) bool: the arm was not asked to move, as at the start of both logs."""
    asked = np.abs(log.signals["target_joint_velocity"].value).max(axis=1) > 0.0
    return np.cumsum(asked) == 0


def _percent(mass: float) -> str:
    return f"{100.0 * (mass / MASS - 1.0):+.1f} %"


def _draw(arm: Arm, loaded: Weighing, free: Weighing, truth: Sensor) -> dict[str, Any]:
    from ..report import joints_figure, mass_figure

    levers, torque = per_kilogram(arm, loaded.log), residual(loaded.log)
    squares = np.cumsum((levers * torque).sum(axis=1)) / np.cumsum((levers**2).sum(axis=1))
    return {
        "Mass from motor currents, with its 95 % band, against the wrist sensor": mass_figure(
            replace(loaded.report(), truth_mass=truth.mass, others={"plain least squares": squares})
        ),
        "The same with nothing in the hand": mass_figure(replace(free.report(), truth_mass=0.0)),
        "External torque of the joints: model minus current, and J^T F of the wrist sensor": joints_figure(
            loaded.time,
            {"wrist sensor": truth.torque, "estimated": loaded.touch.external.torque},
            arm.joint_names,
            quantity="torque",
            unit="N m",
        ),
    }
