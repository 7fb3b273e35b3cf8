"""``palpate arm``: look at an arm, write it in another form."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import ArmError, InputError
from ._common import (
    Base,
    Json,
    Repair,
    Tip,
    check_target,
    console,
    emit,
    examples,
    group,
    is_text,
    open_arm,
    say,
    write_file,
)

if TYPE_CHECKING:
    from ..arm import Arm, WeighingJoint

_Arm = Annotated[str, typer.Argument(metavar="ARM", help="Name of a reference arm, a card or a URDF.")]


def add(app: typer.Typer) -> None:
    """Make the verbs known."""
    verbs = group(app, "arm", "Look at an arm, or write it in another form.")
    verbs.command("list", help="Names of the reference arms.", epilog=examples("palpate arm list"))(names)
    verbs.command(
        "show",
        help="Joints, masses, limits, and the joint that weighs with its lever.",
        epilog=examples(
            "palpate arm show justina_left_arm",
            "palpate arm show justina_left_arm --pose Take3",
            "palpate arm show robot.urdf --base base_link --tip tool0",
        ),
    )(show)
    verbs.command(
        "export",
        help="Write an arm as card, URDF or C++ header. A file named - is the standard output.",
        epilog=examples(
            "palpate arm export robot.urdf --tip tool0 --card robot.arm.yaml",
            "palpate arm export kuka_lbr_iiwa7 --urdf iiwa7.urdf --header iiwa7.hpp",
            "palpate arm export justina_left_arm --card -",
        ),
    )(export)


def names(json: Json = False) -> int:
    """List the reference arms."""
    from .. import robots

    if json:
        emit({"arms": list(robots.names())})
    else:
        for name in robots.names():
            arm = robots.load(name)
            say(f"{name:24} {arm.n} joints, {sum(j.mass for j in arm.joints):.3g} kg")
    return 0


def show(
    arm: _Arm,
    pose: Annotated[
        str | None,
        typer.Option(metavar="POSE", help="Weigh in this pose: a name or angles in rad.", show_default=False),
    ] = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    json: Json = False,
) -> int:
    """Show an arm."""
    model = open_arm(arm, base=base, tip=tip, repair=repair)
    weighs, why = _weighing(model, pose)
    if json:
        emit({**_plain(model), "weighing_joint": weighs, "weighing_note": why})
        return 0
    from rich.table import Table

    table = Table(box=None, padding=(0, 2), header_style="dim")
    table.add_column("joint")
    for name in ("axis", "mass kg", "com m", "limits rad", "rad/s", "N m", "friction"):
        table.add_column(name, justify="left" if name == "axis" else "right")
    for j in model.joints:
        friction = f"{j.friction.coulomb:.3g} + {j.friction.viscous:.3g} v"
        table.add_row(
            j.name,
            _axis(j.axis),
            f"{j.mass:.4g}" if j.mass else "-",
            " ".join(f"{x:.3g}" for x in j.com) if j.mass else "-",
            f"{_limit(j.limits.lower)} .. {_limit(j.limits.upper)}",
            _limit(j.limits.velocity),
            _limit(j.limits.effort),
            friction,
        )
    out = console()
    out.print(f"{model.name}: {model.n} joints from {model.base} to {model.tip}")
    out.print(table)
    mass = sum(j.mass for j in model.joints)
    say(f"mass      {mass:.4g} kg" if mass else "mass      none given: kinematics only")
    say(f"gravity   {' '.join(f'{x:g}' for x in model.gravity)} m/s^2 in {model.base}")
    say(f"grasp     {' '.join(f'{x:g}' for x in model.grasp)} m in {model.tip}")
    say(f"effort    {model.effort.kind}")
    say(f"weighs    {why}")
    for key, text in model.provenance.items():
        say(f"source    {key}: {text}")
    return 0


def _weighing(arm: Arm, pose: str | None) -> tuple[dict[str, Any] | None, str]:
    """The joint to weigh with: over all poses, or else in the one asked for or the usual one."""
    import numpy as np

    from ..weigh import find_pose, scene, telling_pose

    if pose is None:
        lower = np.array([max(j.limits.lower, -math.pi) for j in arm.joints])
        upper = np.array([min(j.limits.upper, math.pi) for j in arm.joints])
        try:
            return _describe(arm.weighing_joint((lower, upper)), "in every pose")
        except ArmError:
            pass  # the usual case: it depends on the pose
    elif not arm.has_dynamics:
        raise InputError("--pose needs an arm with masses")
    if arm.has_dynamics:
        name, q = find_pose(known := scene(arm), pose or known.pose)
    else:
        q = telling_pose(arm, 1.0)
        name = ",".join(f"{x:g}" for x in q)
    try:
        return _describe(arm.weighing_joint(q), f"in pose {name}")
    except ArmError as error:
        return None, f"in pose {name}: {str(error).split(': ', 1)[-1]}"


def _describe(found: WeighingJoint, where: str) -> tuple[dict[str, Any], str]:
    plain = {
        "index": found.index,
        "name": found.name,
        "lever_m": [found.lever, found.lever_max],
        "radius_m": found.radius,
        "perpendicularity": found.perpendicularity,
        "sin_angle": found.sin_angle,
    }
    same = found.lever == found.lever_max
    lever = f"{found.lever:.3f} m" if same else f"{found.lever:.3f} to {found.lever_max:.3f} m"
    return plain, f"{where} {found.name}: lever {lever}, grasp point {found.radius:.3f} m from its axis"


def _axis(axis: Any) -> str:
    for i, name in enumerate("xyz"):
        if abs(axis[i]) > 1.0 - 1e-9:
            return name if axis[i] > 0.0 else f"-{name}"
    return " ".join(f"{x:.3g}" for x in axis)


def _limit(value: float) -> str:
    return "-" if math.isinf(value) else f"{value:.4g}"


def _plain(arm: Arm) -> dict[str, Any]:
    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return {
        "name": arm.name,
        "base": arm.base,
        "tip": arm.tip,
        "gravity_m_s2": arm.gravity.tolist(),
        "grasp_m": arm.grasp.tolist(),
        "effort": arm.effort.kind,
        "has_dynamics": arm.has_dynamics,
        "joints": [
            {
                "name": j.name,
                "link": j.link,
                "kind": j.kind,
                "axis": j.axis.tolist(),
                "mass_kg": j.mass,
                "com_m": j.com.tolist(),
                "lower_rad": finite(j.limits.lower),
                "upper_rad": finite(j.limits.upper),
                "velocity_rad_s": finite(j.limits.velocity),
                "effort_Nm": finite(j.limits.effort),
                "coulomb_Nm": j.friction.coulomb,
                "viscous_Nms_rad": j.friction.viscous,
            }
            for j in arm.joints
        ],
        "provenance": dict(arm.provenance),
    }


def export(
    arm: _Arm,
    card: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a card (YAML).")] = None,
    urdf: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a URDF.")] = None,
    header: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a C++20 header.")] = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
) -> int:
    """Export an arm."""
    from ..session import card_text

    if card is None and urdf is None and header is None:
        raise InputError("nothing to write: give --card, --urdf or --header and a file")
    model = open_arm(arm, base=base, tip=tip, repair=repair)
    for path, text in ((card, card_text), (urdf, type(model).to_urdf), (header, type(model).to_header)):
        if path is None:
            continue
        content: str = text(model)
        if str(path) == "-":
            typer.echo(content, nl=False)
            continue
        check_target(path, is_text, "the export")
        write_file(path, content.encode("utf-8"))
        say(str(path))
    return 0
