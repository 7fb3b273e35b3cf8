"""A run as one log of both sides, and as a report."""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path

import numpy as np

from .._core import __version__, turn_between
from ..logs import Recorder
from ..report import StudyRow, joints_figure, write_study
from .coupling import Event, event_words
from .figures import Transparency, jumps, transparency, turning
from .session import Cut, Run
from .setups import Setup

_SIGNALS = {
    "master_position": ("device", "m"),
    "master_velocity": ("device_velocity", "m/s"),
    "master_force": ("force", "N"),
    "master_felt": ("felt", "N"),
    "slave_tip": ("tip", "m"),
    "slave_reference": ("reference", "m"),
    "slave_force": ("estimated", "N"),
    "slave_force_std": ("std", "N"),
    "true_force": ("true", "N"),
    "tank_levels": ("levels", "J"),
}
_TURN_SIGNALS = {
    "master_turn": ("device_turn", "rad"),
    "master_torque": ("torque", "N m"),
    "master_felt_torque": ("felt_torque", "N m"),
    "slave_turn": ("tip_turn", "rad"),
    "slave_reference_turn": ("reference_turn", "rad"),
    "slave_torque": ("estimated_torque", "N m"),
    "slave_torque_std": ("torque_std", "N m"),
    "true_torque": ("true_torque", "N m"),
}


def record(run: Run, setup: Setup, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
    """Write both sides of a run into one recording, on the master's clock.

    The joint states are the slave's; what belongs to the master has a name that says so.

    Raises:
        LogError: the path exists, or cannot be written.
    """
    arm = setup.slave.model
    session = {
        "what": "teleoperation" if setup.scene is None else f"teleoperation: {setup.scene.text}",
        "palpate": __version__,
        "clock_offset_s": f"{run.offset:.9g}",
        "round_trip_s": f"{run.round_trip:.9g}",
        "motion_scale": f"{setup.motion_scale:g}",
    }
    units = {} if setup.slave.pose else {"m": "rad", "m/s": "rad/s", "N": "N m"}
    signals = _SIGNALS | (_TURN_SIGNALS if setup.slave.pose else {})
    with Recorder(path, arm.joint_names, session=session, overwrite=overwrite) as out:
        events = list(run.reasons)
        for k, time in enumerate(run.time):
            now = round(time * 1e9)
            while events and events[0][0] <= time:
                out.event(now, "held", events.pop(0)[1])
            out.sample(now, run.q[k], None, run.effort[k])
            for name, (column, unit) in signals.items():
                out.signal(name, now, getattr(run, column)[k], units.get(unit, unit))
            out.signal("master_events", now, float(run.master_events[k]))
            out.signal("slave_events", now, float(run.slave_events[k]))
        for time, _, mass, std in run.held:
            out.payload(round(time * 1e9), mass, std)
    return Path(path)


def found(run: Run, setup: Setup, cuts: tuple[Cut, ...] = ()) -> Transparency:
    """The figures of a run in its setup; `cuts` is taken for what it is: nothing is judged while the link is dead."""
    scale, stiffness = setup.follower.force_scale, None if setup.scene is None else setup.scene.stiffness
    return transparency(run, force_scale=scale, stiffness=None if cuts else stiffness)


def rows(run: Run, setup: Setup, cuts: tuple[Cut, ...] = ()) -> list[StudyRow]:
    """What was found, for people; nothing is judged."""
    t = found(run, setup, cuts)

    def row(what: str, value: float, unit: str, note: str = "") -> StudyRow | None:
        return StudyRow(what, ours=value, unit=unit, note=note) if math.isfinite(value) else None

    in_space = setup.slave.pose
    N, mm, mm_s = ("N", "mm", "mm/s") if in_space else ("N m", "mrad", "mrad/s")
    contact_error = float(np.abs(np.linalg.norm(run.estimated - run.true, axis=1)).mean())
    every = [
        row("tool away from where the hand points, nothing touched, at most", 1e3 * t.tracking, mm),
        row("force of the device, nothing touched, at most", t.free_force, N),
        row(
            "force felt off the true one, mean",
            100.0 * t.force_error,
            "%",
            f"while {t.force_held:.3g} {N} are held",
        ),
        row("stiffness felt, part of what the tool meets", 100.0 * t.stiffness, "%"),
        row("felt after the touch", 1e3 * t.onset, "ms"),
        row("estimated against true force, mean", contact_error, N),
        row("largest true force", float(np.linalg.norm(run.true, axis=1).max(initial=0.0)), N),
    ]
    if in_space:
        u = turning(run, torque_scale=setup.follower.torque_scale)
        every += [
            row(
                "tool turned away from where the hand turns it, nothing touched, at most",
                1e3 * u.tracking,
                "mrad",
            ),
            row("largest true torque about the tool's tip", u.torque, "N m"),
            row("estimated against true torque, mean", u.estimate_error, "N m", "while it is touched"),
            row(
                "torque felt off the true one, mean",
                100.0 * u.torque_error,
                "%",
                f"while {u.torque_held:.3g} N m are held",
            ),
        ]
    for time, true, mass, std in run.held:
        every.append(
            row(
                f"object lifted at {time:.1f} s, of {true:g} kg: weighed",
                mass,
                "kg",
                f"± {1.96 * std:.3f} kg (95 %)",
            )
        )
    if cuts:
        force, speed, moved = jumps(run, cuts)
        every += [
            row("dead link: force changes within 10 ms of the return by at most", force, N),
            row("dead link: velocity of the tool changes within 10 ms by at most", 1e3 * speed, mm_s),
            row("dead link: the slave's reference moves meanwhile", 1e3 * moved, mm),
        ]
    for side, tank in run.tanks.items():
        every.append(row(f"{side}: energy taken less given at the port", tank["taken"] - tank["given"], "J"))
    every += [
        row(
            "bandwidth, to the slave and back",
            max(run.bandwidth) / 1e6,
            "Mbit/s",
            f"{run.bandwidth[0] / 1e6:.2f} and {run.bandwidth[1] / 1e6:.2f}",
        ),
        row("round trip of the quickest message", 1e3 * run.round_trip, "ms"),
    ]
    return [r for r in every if r is not None]


def write_report(
    run: Run,
    setup: Setup,
    path: str | PathLike[str],
    *,
    settings: dict[str, object],
    cuts: tuple[Cut, ...] = (),
) -> Path:
    """Write a run as one self-contained HTML file, with its rows as Markdown and JSON beside it.

    Raises:
        InputError: a file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    scale = setup.follower.force_scale
    joints = setup.slave.model.joint_names
    in_space = setup.slave.pose
    axes = ("x", "y", "z") if in_space else joints
    force, place, N, m = ("force", "place", "N", "m") if in_space else ("torque", "angle", "N m", "rad")
    forces = {"true": run.true, "estimated": run.estimated, "felt": run.felt / scale}
    places = {"where the hand points": run.wanted, "tool": run.tip}
    figures = {
        "Force on the tool: true (MuJoCo), estimated without a force sensor, felt by the hand": joints_figure(
            run.time, forces, axes, quantity=force, unit=N
        ),
        "Where the hand points, and where the tool is": joints_figure(
            run.time, places, axes, quantity=place, unit=m
        ),
        "Energy in the tanks of the two sides": joints_figure(
            run.time, {"level": run.levels}, ("master", "slave"), quantity="energy", unit="J"
        ),
    }
    if in_space:
        torques = {"true": run.true_torque, "estimated": run.estimated_torque}
        if np.any(run.felt_torque):
            torques["felt"] = run.felt_torque / setup.follower.torque_scale
        away = np.array([turn_between(*row) for row in zip(run.wanted_turn, run.tip_turn, strict=True)])
        figures |= {
            "Torque about the tool's tip": joints_figure(
                run.time, torques, axes, quantity="torque", unit="N m"
            ),
            "The tool turned away from where the hand turns it": joints_figure(
                run.time, {"turned away": away}, axes, quantity="angle", unit="rad"
            ),
        }
    told = [f"{time:.3f} s: {reason}" for time, reason in run.reasons]
    seen = np.bitwise_or.reduce(np.concatenate((run.master_events, run.slave_events))) if len(run.time) else 0
    told += [f"happened: {words}" for words in event_words(int(Event(int(seen)))).split("; ") if words]
    told += [f"{count} packets refused: {kind}" for kind, count in run.refused.items()]
    told += [f"assumed: {sentence}" for sentence in setup.assumed]
    title = "Teleoperation" if setup.scene is None else f"Teleoperation: {setup.scene.text}"
    files = write_study(
        rows(run, setup, cuts),
        figures,
        path,
        title=title,
        text="palpate teleop",
        settings=settings,
        provenance=told,
    )
    return files.html
