"""``palpate identify``: from logs to an arm's dynamics, friction and gains."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError, LogError, suggest
from ._common import (
    Base,
    Columns,
    Effort,
    Json,
    Quiet,
    Repair,
    Tip,
    check_target,
    column_map,
    console,
    emit,
    examples,
    is_report,
    is_text,
    open_arm,
    say,
    write_file,
)

if TYPE_CHECKING:
    from ..arm import Arm
    from ..identify import Fit, GainFit, LoadEstimate
    from ..logs import Log


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "identify",
        help="Learn an arm's dynamics, friction and drive gains from logs of its motion.\n\n"
        "LOG is free motion of every joint, both ways, varied (palpate excite makes it); about half a "
        "minute. Writes a "
        "card for the other commands and report.html: measured against predicted torque, residual spectra, "
        "every "
        "parameter with its standard deviation. Known data sets (UR10e, Kinova, KUKA LWR, LARA 8) are "
        "recognised.",
        epilog=examples(
            "palpate identify free.mcap --arm robot.urdf --tip tool0 --effort torque -o robot.arm.yaml",
            "palpate identify a.csv b.csv --test c.csv --arm robot.urdf --effort current:11.9,11.9,9.8 -o "
            "robot.arm.yaml",
            "palpate identify free.csv --gains --load 2.8@loaded.csv --arm robot.urdf -o robot.arm.yaml",
            "palpate identify pos.csv.gz,curr.csv.gz --columns tx40 --coupling joint_5+joint_6 --arm tx40.urdf "
            "--repair-inertia -o tx40.arm.yaml",
        ),
    )(run)


def run(
    logs: Annotated[
        list[str], typer.Argument(metavar="LOG...", help="Free motion: .mcap, rosbag2 folder, .csv, .npz.")
    ],
    arm: Annotated[str, typer.Option(metavar="ARM", help="Name of a reference arm, a card or a URDF.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="CARD", help="Card to write.")],
    urdf: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write a URDF with what was found.")
    ] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Report to write.")] = Path(
        "report.html"
    ),
    no_report: Annotated[bool, typer.Option("--no-report", help="Write no report.")] = False,
    test: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LOG",
            help="Log to test the result on; again for the next one. [default: each log, or each third of the only "
            "one, is predicted from the rest]",
            show_default=False,
        ),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KG@LOG",
            help="Motion with a known mass in the hand: to find the gains with --gains, else to weigh it as a test.",
            show_default=False,
        ),
    ] = None,
    gains: Annotated[bool, typer.Option("--gains", help="Find the drive gains, too (needs --load).")] = False,
    method: Annotated[
        str,
        typer.Option(metavar="NAME", help="consistent (links that can exist), damped, irls, wls or ols."),
    ] = "consistent",
    friction: Annotated[
        str, typer.Option(metavar="NAME", help="coulomb, stribeck, load or stribeck+load.")
    ] = "stribeck+load",
    coupling: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT+JOINT",
            help="A drive that turns with several joints; again for the next one.",
            show_default=False,
        ),
    ] = None,
    cad: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder with the meshes the URDF names: links of uniform density as prior."
        ),
    ] = None,
    density: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Density of the meshes [kg/m^3]. [default: each link's own mass over its volume]",
            show_default=False,
        ),
    ] = None,
    prior: Annotated[float, typer.Option(metavar="X", help="Weight of the arm's own masses.")] = 1.0,
    cutoff: Annotated[
        float | None,
        typer.Option(
            metavar="HZ",
            help="Low-pass of torques and model; four rows are kept per period of it. [default: from the motion]",
            show_default=False,
        ),
    ] = None,
    partial: Annotated[
        bool, typer.Option("--partial", help="Fit what was seen although some joints were not.")
    ] = False,
    columns: Columns = None,
    effort: Effort = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Identify."""
    from .. import identify as identification

    check_target(out, is_text, "the card")
    page = None if no_report else report
    for path, ours, what in ((page, is_report, "the report"), (urdf, is_text, "the URDF")):
        if path is not None:
            check_target(path, ours, what)
    if gains and not load:
        raise InputError(
            "--gains needs --load KG@LOG: from free motion alone only the ratios of torques to gains are "
            "identifiable "
            "(twice the masses with twice the gains explain it as well)"
        )
    silent = json or quiet
    model = open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
    remarks: list[str] = []
    with _progress("reading", silent):
        if cad is not None:
            model, said = identification.with_meshes(model, cad, density=density)
            remarks += said
        free = [_open(text, columns, model, remarks) for text in logs]
        held = [_open(text, columns, model, remarks) for text in test or ()]
        loads = [(kg, name, _open(name, columns, model, remarks)) for kg, name in map(_load, load or ())]
    if not gains:
        model = _declare(model, free, remarks)
    friction_model = identification.FrictionModel.named(
        friction, [_coupling(c, model) for c in coupling or ()]
    )
    found_gains: GainFit | None = None
    if gains:
        masses = {kg for kg, _, _ in loads}
        if len(masses) > 1:
            raise InputError(f"--gains takes logs with one and the same load, got {sorted(masses)} kg")
        with _progress("finding the gains", silent):
            found_gains = identification.fit_gains(
                model,
                free,
                [log for _, _, log in loads],
                identification.KnownLoad(masses.pop()),
                friction=friction_model,
                cutoff=cutoff,
            )
        model = found_gains.arm
        # the gains are per unit of whatever the effort is
        free, held = ([_without_unit(log) for log in part] for part in (free, held))
    with _progress("fitting", silent):
        fit = identification.fit(
            model,
            free,
            friction=friction_model,
            method=method,  # type: ignore[arg-type]  # fit names the choices
            cutoff=cutoff,
            prior=prior,
            validate_on=held or None,
        )
    if fit.blind and not partial:
        raise LogError(
            "; ".join(fit.unseen)
            + "; record such motion (palpate excite makes it), or fit the rest with --partial"
        )
    weighed = [] if gains else [(kg, name, identification.estimate_load(fit, log)) for kg, name, log in loads]
    result = fit.arm.replace(provenance=_provenance(fit, logs, test, load, gains))
    files = {"card": str(out)}
    result.save(out)
    if urdf is not None:
        write_file(urdf, result.to_urdf().encode("utf-8"))
        files["urdf"] = str(urdf)
    if page is not None:
        from ..report import write_identify_report

        with _progress("writing the report", silent):
            shown = list(zip(test, held, strict=True)) if test else list(zip(logs, free, strict=True))[:1]
            predictions = {Path(text.split(",")[0]).name: fit.predict(log) for text, log in shown}
            lines = [f"{k}: {v}" for k, v in result.provenance.items()]
            notes = [f"log {k + 1}: {note}" for k, o in enumerate(fit.origins) for note in o.notes]
            write_identify_report(
                fit,
                predictions,
                page,
                title=f"What {model.name} is made of",
                gains=found_gains,
                remarks=[*remarks, *(_weighed(*w) for w in weighed)],
                provenance=[*lines, *notes],
            )
        files["report"] = str(page)
    if json:
        emit(_plain(fit, found_gains, weighed, remarks, files))
        return 0
    if not quiet:
        _tell(fit, found_gains, [*remarks, *(_weighed(*w) for w in weighed)])
    for file in files.values():
        say(file)
    return 0


# -- in -------------------------------------------------------------------------------------------------------


def _open(text: str, columns: str | None, arm: Arm, remarks: list[str]) -> Log:
    """A log with the arm's joints in its order; broken rows are dropped and counted."""
    from ..logs import Log, open_known, read_tx40
    from ..weigh import fit_joints

    if columns == "tx40":
        position, comma, current = text.partition(",")
        if not comma:
            raise InputError(f"--columns tx40: a log is two files, POSITIONS,CURRENTS; got {text!r}")
        log = read_tx40(position, current)
    elif columns is None:
        log, name = open_known(text, arm.n)
        if name is not None:
            remarks.append(f"{Path(text).name}: recognised as a log of the data set {name}")
    else:
        log = Log.open(text, column_map(columns))
    dropped = sum(log.repair.dropped.values())
    if dropped:
        why = ", ".join(f"{reason} {count}" for reason, count in log.repair.dropped.items())
        remarks.append(f"{Path(text).name}: {dropped} rows dropped ({why})")
    log, said = fit_joints(log, arm)
    remarks += [r for r in said if r not in remarks]
    # what they are called does not matter any more
    return log if log.joint_names == arm.joint_names else replace(log, joint_names=arm.joint_names)


def _declare(arm: Arm, logs: Sequence[Log], remarks: list[str]) -> Arm:
    """The arm with torque as its effort where only the logs say so."""
    from ..arm import Effort

    units = {log.meta.get("effort_unit", "") for log in logs}
    if arm.effort.kind != "undeclared":
        return arm
    if units == {"N m"}:
        remarks.append("the logs' effort is in N m and is taken for the torque of the links' side")
        return arm.replace(effort=Effort.torque())
    what = "a current [A]" if units == {"A"} else "of no stated unit"
    raise InputError(
        f"the logs' effort is {what} and neither the arm nor --effort says what it is worth: give --effort "
        "torque, or "
        "--effort current:GAIN,... [N m/A], or find the gains with --gains --load KG@LOG (a log with a "
        "known load: from "
        "free motion only the ratios of torques to gains are identifiable)"
    )


def _without_unit(log: Log) -> Log:
    return replace(log, meta={k: v for k, v in log.meta.items() if k != "effort_unit"})


def _load(text: str) -> tuple[float, str]:
    mass, at, path = text.partition("@")
    try:
        value = float(mass)
    except ValueError:
        value = math.nan
    if not at or not path or not 0.0 < value < math.inf:
        raise InputError(f"--load: expected KG@LOG such as 2.8@loaded.csv, got {text!r}")
    return value, path


def _coupling(text: str, arm: Arm) -> Any:
    from ..identify import Coupling

    joints = []
    for name in text.split("+"):
        if name not in arm.joint_names:
            raise InputError(f"--coupling: no joint {name!r}; {suggest(name, arm.joint_names, 'joints')}")
        joints.append(arm.joint_names.index(name))
    return Coupling(tuple(joints))


def _provenance(
    fit: Fit, logs: Sequence[str], test: Sequence[str] | None, load: Sequence[str] | None, gains: bool
) -> dict[str, str]:
    """Of the card: what it was made of, without a date, so that the same command writes the same bytes."""
    found = dict(fit.arm.provenance)
    for k, text in enumerate(logs):
        found[f"log {k + 1}"] = _fingerprint(text)
    for k, text in enumerate(test or ()):
        found[f"test log {k + 1}"] = _fingerprint(text)
    for k, text in enumerate(load or ()):
        mass, _, path = text.partition("@")
        found[f"log with load {k + 1}"] = f"{mass} kg, {_fingerprint(path)}"
    held = fit.held_out or fit.residuals
    found["method"] = f"{fit.method}, friction {'+'.join(fit.friction.terms)}" + (
        ", gains found" if gains else ""
    )
    found["residual"] = f"{held.relative_overall:.4f} of the torque, {held.overall:.4g} N m RMS ({held.what})"
    return found


def _fingerprint(text: str) -> str:
    parts = []
    for name in text.split(","):
        path = Path(name)
        files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
        digest = hashlib.sha256()
        for file in files:
            digest.update(file.read_bytes())
        parts.append(f"{path.name} sha256 {digest.hexdigest()}")
    return ", ".join(parts)


@contextmanager
def _progress(what: str, silent: bool) -> Iterator[None]:
    """A spinner on a terminal, nothing elsewhere."""
    out = console()
    if silent or not out.is_terminal:
        yield
        return
    with out.status(what):
        yield


# -- out ------------------------------------------------------------------------------------------------------


def _weighed(mass: float, name: str, found: LoadEstimate) -> str:
    low, high = found.interval
    weighs = f"weighs {found.mass:.3f} kg, 95 % interval {low:.3f} to {high:.3f} kg"
    return f"{Path(name).name}: {weighs}; said to be {mass:g} kg"


def _tell(fit: Fit, gains: GainFit | None, remarks: Sequence[str]) -> None:
    from rich.table import Table

    from ..report._text import rounded
    from ..report.identify import source, trusted

    named = {e.name: e for e in fit.parameters}

    def cell(name: str, joint: int, *, hides: bool = True) -> str:
        if hides and joint in fit.blind:
            return "not seen"
        e = named[name]
        value, half = rounded(e.value, 1.96 * e.std)
        return f"{value} ± {half}" + ("" if source(e) == "data" else " *")

    held = fit.held_out
    table = Table(box=None, padding=(0, 2), header_style="dim")
    table.add_column("joint")
    for name in ("residual N m", "held out N m", "Coulomb N m", "viscous N m s", "rotor kg m²", "link kg"):
        table.add_column(name, justify="right")
    for j, joint in enumerate(fit.arm.joints):
        table.add_row(
            joint.name,
            f"{fit.residuals.rms[j]:.3g} ({fit.residuals.relative[j]:.1%})",
            "-" if held is None else f"{held.rms[j]:.3g} ({held.relative[j]:.1%})",
            cell(f"{joint.name}.coulomb", j),
            cell(f"{joint.name}.viscous", j),
            cell(f"{joint.name}.rotor_inertia", j) if fit.friction.rotor_inertia else "-",
            cell(f"{joint.link}.m", j, hides=False),
        )
    out = console()
    samples = sum(o.used for o in fit.origins)
    say(
        f"{fit.arm.name}: {samples} samples, {fit.residuals.rows} rows per joint, {fit.method} fit in "
        f"{fit.seconds[1]:.2f} s"
    )
    out.print(table)
    say("± is half of the 95 % interval; * is more the prior's word than the data's: do not rely on it alone")
    overall = f"unexplained  {fit.residuals.relative_overall:.1%} of the torque, {fit.residuals.overall:.3g} N m RMS"
    if held is not None:
        overall += f"; held out {held.relative_overall:.1%}, {held.overall:.3g} N m ({held.what})"
    say(overall)
    good = trusted(fit)
    zero = [
        name
        for name, value, std in zip(fit.base.names, fit.base.value, fit.base.std, strict=True)
        if std >= 0.5 * abs(value)
    ]
    say(
        f"base         {fit.base.rank} of {fit.base.structural_rank} parameters seen, {sum(good)} to better "
        "than 10 %, "
        f"{len(good) - sum(good) - len(zero)} roughly; conditioning {fit.base.conditioning:.3g}"
    )
    if zero:
        listed = ", ".join(zero[:8]) + (f" and {len(zero) - 8} more" if len(zero) > 8 else "")
        say(f"             not told from 0: {listed}")
    if gains is not None:
        pairs = (rounded(float(k), 1.96 * float(s)) for k, s in zip(gains.gain, gains.std, strict=True))
        for joint, (value, half) in zip(fit.arm.joints, pairs, strict=True):
            say(f"gain         {joint.name} {value} ± {half} N m per unit of effort")
    for sentence in (*fit.unseen, *remarks):
        say(f"! {sentence}")


def _plain(
    fit: Fit,
    gains: GainFit | None,
    weighed: Sequence[tuple[float, str, LoadEstimate]],
    remarks: Sequence[str],
    files: dict[str, str],
) -> dict[str, Any]:
    from ..report.identify import source

    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    def residuals(found: Any) -> dict[str, Any] | None:
        if found is None:
            return None
        return {
            "what": found.what,
            "rms_Nm": found.rms.tolist(),
            "relative": [finite(v) for v in found.relative],
            "overall_Nm": found.overall,
            "relative_overall": found.relative_overall,
            "rows": found.rows,
        }

    hidden = {
        f"{fit.arm.joints[j].name}.{t}" for j in fit.blind for t in (*fit.friction.terms, "rotor_inertia")
    }
    return {
        "arm": fit.arm.name,
        "joints": list(fit.arm.joint_names),
        "method": fit.method,
        "cutoff_Hz": fit.cutoff,
        "seconds": {"least_squares": fit.seconds[0], "all": fit.seconds[1]},
        "residuals": residuals(fit.residuals),
        "held_out": residuals(fit.held_out),
        "conditioning": fit.base.conditioning,
        "rank": fit.base.rank,
        "structural_rank": fit.base.structural_rank,
        "parameters": [
            {
                "name": e.name,
                "value": None if e.name in hidden else e.value,
                "std": None if e.name in hidden else e.std,
                "unit": e.unit,
                "prior": finite(e.prior),
                "seen": finite(e.seen),
                "source": "not seen" if e.name in hidden else source(e),
            }
            for e in fit.parameters
        ],
        "base_parameters": [
            {"name": n, "value": float(v), "std": float(s)}
            for n, v, s in zip(fit.base.names, fit.base.value, fit.base.std, strict=True)
        ],
        "gains": None if gains is None else {"value": gains.gain.tolist(), "std": gains.std.tolist()},
        "loads": [
            {"log": name, "said_kg": kg, "mass_kg": e.mass, "mass_std_kg": e.mass_std}
            for kg, name, e in weighed
        ],
        "not_seen": list(fit.unseen),
        "remarks": list(remarks),
        "files": files,
    }
