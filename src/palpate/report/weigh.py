"""The report on one weighing: a single HTML file, from the number in large type down to the settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import _files, _page
from ._series import Array
from ._style import OTHERS, data_url, decode_png, drawing, svg
from ._text import TWO_SIDED_95, clean, escape, mass_unit, number, rounded, status_text
from .figures import error_figure, joints_figure, mass_figure, normalised_error, torque_figure
from .weighing import WeighReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 40_000
"""shared by all curves in the panels of the joints, so that a page of many joints is no larger than one of few"""

_KEYS = {
    "measured": ("measured", "grey", "line"),
    "estimated": ("estimated", "blue", "line"),
    "desired": ("desired", "ink", "dash"),
}


def write_weigh_report(report: WeighReport, path: str | PathLike[str]) -> Path:
    """Write one self-contained HTML file; the same bytes for the same data.

    Args:
        report: the data; see :class:`WeighReport`.
        path: file to write.

    Raises:
        InputError: the picture is not a PNG, or the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    with drawing():
        sections = [header(report.title, report.arm, report.time_s), _card(report)]
        if len(report.time_s):
            sections += [_mass(report), _comparison(report), *_joints(report), _error(report)]
        if report.settings:
            sections.append(_page.section("Settings", _page.mapping_table(report.settings)))
        if report.repair:
            sections.append(_page.section("What was repaired in the log", _page.lines(report.repair)))
        if report.provenance:
            sections.append(_page.section("Where arm and data come from", _page.lines(report.provenance)))
        sections.append(footer("Bands and “±” of the mass are 95 % (1.96 standard deviations)."))
    return _files.write(path, _page.page(report.title, (s for s in sections if s)))


def footer(more: str) -> str:
    """The conventions, and how uncertainty is shown."""
    return (
        "<footer>Signs: M(q) q̈ + C(q, q̇) q̇ + g(q) + τ_f(q̇) = τ + τ_ext; τ_ext is positive when the environment "
        f"pushes the robot. SI units. {more}</footer>"
    )


def header(title: str, arm: str, time: Array) -> str:
    """Title, arm, and how much was recorded; `time` (N,) [s]."""
    parts = [arm] if arm else []
    if len(time) > 1:
        spacing = float(np.median(np.diff(time)))
        rate = f" at {number(1.0 / spacing, 3)} Hz" if spacing > 0.0 else ""
        parts.append(f"{number(float(np.ptp(time)), 3)} s, {len(time)} samples{rate}")
    elif not len(time):
        parts.append("no samples")
    return f'<header><h1>{escape(title)}</h1><p class="sub">{escape(" · ".join(parts))}</p></header>'


def _card(report: WeighReport) -> str:
    mass, std = report.headline.mass, report.headline.std
    status = status_text(report.headline.status)
    factor, unit = mass_unit([mass])
    value, half = rounded(mass * factor, TWO_SIDED_95 * std * factor)
    spread = "" if half == "?" else f" <small>± {half} {unit}</small>"
    words = [
        f'<div class="number">{value} <small>{unit}</small>{spread}</div>',
        '<p class="read">'
        + ("no standard deviation was given" if half == "?" else "± is half of the 95 % interval (1.96 σ)")
        + ("" if _at_end(report) else f", known at {number(report.headline.time_s, 4)} s")
        + "</p>",
        f'<p><span class="pill" style="--tone:var(--{status.colour})">{escape(status.name)}</span>'
        f"{escape(status.meaning)}</p>",
    ]
    facts = _facts(report, mass, std, factor, unit)
    if facts:
        words.append('<dl class="facts">' + "".join(facts) + "</dl>")
    image = ""
    if report.picture is not None:
        height, width = decode_png(report.picture).shape[:2]  # a picture that is none is an error, not a hole
        image = f'<img src="{data_url(report.picture)}" width="{width}" height="{height}" alt="the arm with its load">'
    return f'<div class="card"><div class="words">{"".join(words)}</div>{image}</div>'


def _at_end(report: WeighReport) -> bool:
    time = report.time_s
    return not len(time) or report.headline.time_s >= float(time[-1])


def fact(name: str, value: str, more: str = "") -> str:
    """A name and its value in a list of facts."""
    small = f"<small>{escape(more)}</small>" if more else ""
    return f"<div><dt>{escape(name)}</dt><dd>{escape(value)}{small}</dd></div>"


def _facts(report: WeighReport, mass: float, std: float, factor: float, unit: str) -> list[str]:
    facts = []
    truth = report.headline.truth
    if math.isfinite(truth):
        facts.append(fact("truth", f"{number(truth * factor)} {unit}"))
        error = mass - truth
        if math.isfinite(error):
            more = [f"{_signed(100.0 * error / truth, 2)} %"] if truth else []
            if std > 0.0:
                more.append(f"{number(abs(error) / std, 2)} σ")
            facts.append(fact("error", f"{_signed(error * factor, 2)} {unit}", ", ".join(more)))
    settling = report.time_to_2_percent_s
    if settling is not None:
        never = not math.isfinite(settling)
        facts.append(fact("time to 2 %", "not reached" if never else f"{number(settling, 3)} s"))
    changes = len(np.asarray(report.changes))
    if changes:
        facts.append(fact("changes of load found", str(changes)))
    return facts


def _signed(value: float, digits: int) -> str:
    text = number(value, digits)
    return text if text.startswith("−") or value == 0.0 else f"+{text}"


def _both(build: Callable[[bool], Figure], label: str, prefix: str) -> str:
    """A figure drawn twice: for a page and for a phone."""
    return "".join(
        f'<figure class="{name}">{svg(build(narrow), label, prefix + name[0])}</figure>'
        for name, narrow in (("wide", False), ("narrow", True))
    )


def _mass(report: WeighReport) -> str:
    key = [("palpate", "blue", "line")]
    if np.isfinite(report.std).any():
        key.append(("95 % band", "blue", "area"))
    if report.truth_known:
        key.append(("truth", "ink", "dash"))
    key += [(name, OTHERS[i % len(OTHERS)], "line") for i, name in enumerate(report.others)]
    text = (
        "The line is the estimated mass, the shade around it holds the truth in 95 of 100 cases if the model is right; "
        "the close-up shows our estimate once settled, at a scale at which that shade has a width. "
        "The strip below the time axis is the status of every moment; where it is not ok the picture is tinted and the "
        "line is pale: do not use the number there."
    )
    if len(np.asarray(report.changes)):
        text += " Dotted lines: the estimator found that an object was taken or released."
    figures = _both(lambda narrow: mass_figure(report, narrow=narrow), "mass over time", "mass")
    return _page.section("Mass", _page.key(key, narrow=True), figures, _statuses(report), _page.read(text))


def _statuses(report: WeighReport) -> str:
    """How often each status occurred, and what it means."""
    status = report.status
    values, counts = np.unique(status, return_counts=True)
    parts = []
    for value, count in sorted(zip(values.tolist(), counts.tolist(), strict=True), key=lambda p: -p[1]):
        text = status_text(value)
        share = 100.0 * count / len(status)
        shown = f"{share:.1f} %" if share >= 0.05 else f"{count} samples"
        parts.append((f"{text.name} {shown}: {text.meaning}", text.colour, "area"))
    return _page.key(parts)


def _comparison(report: WeighReport) -> str:
    """Every estimator at the same moment, if there is more than one or a truth to compare with."""
    if not report.others:
        return ""
    time = report.time_s
    row = report.row_at(report.headline.time_s)
    begin, end = report.settled
    shown = (time >= begin) & (time <= end)
    truth = report.truth_at(time)
    known = bool(np.isfinite(truth[shown]).any())
    factor, unit = mass_unit([report.headline.mass, *report.truth[1].tolist()])
    rows = []
    for name, series in (("palpate", report.mass), *report.others.items()):
        mass = float(series[row]) if row is not None else math.nan
        cells = [escape(name), f"{number(mass * factor, 5)} {unit}"]
        if known:
            error = mass - report.headline.truth
            settled = (series - truth)[shown]
            settled = settled[np.isfinite(settled)]
            rms = math.sqrt(float(np.mean(np.square(settled)))) if settled.size else math.nan
            cells.append(f"{_signed(error * factor, 2)} {unit}" if math.isfinite(error) else "–")
            cells.append(f"{number(rms * factor, 2)} {unit}")
        rows.append(cells)
    head = ["estimator", f"mass at {number(report.headline.time_s)} s"]
    if known:
        head += ["error then", f"rms error, {number(begin, 3)} to {number(end, 3)} s"]
    note = _page.read("Same samples, same moment. The last column covers the time of the close-up above.")
    return _page.section("Estimators side by side", _page.table(head, rows, frozenset((1, 2, 3))), note)


def _unit(report: WeighReport, joint: int, revolute: str, prismatic: str) -> str:
    return prismatic if report.joint_kinds and report.joint_kinds[joint] == "prismatic" else revolute


def panels(names: Sequence[str], build: Callable[[int], Figure], what: str, prefix: str) -> str:
    """One small figure per name, so that the page can put as many beside each other as fit."""
    parts = [
        f"<figure>{svg(build(j), f'{what} of {clean(name, 60)}', f'{prefix}{j}')}</figure>"
        for j, name in enumerate(names)
    ]
    return f'<div class="panels">{"".join(parts)}</div>'


def _joints(report: WeighReport) -> list[str]:
    series = [
        ("measured", report.q_measured, report.dq_measured),
        ("estimated", report.q_estimated, report.dq_estimated),
        ("desired", report.q_desired, report.dq_desired),
    ]
    positions = {name: q for name, q, _ in series if q is not None}
    speeds = {name: dq for name, _, dq in series if dq is not None}
    torque = report.external_torque
    effort = report.effort
    n = len(report.joint_names)
    lines = n * (len(positions) + len(speeds) + 2 * (torque is not None) + (effort is not None))
    points = min(max(_POINTS // max(lines, 1), 120), 900)
    sections = []
    for heading, curves, units, prefix, text in (
        (
            "Positions",
            positions,
            ("rad", "m"),
            "q",
            "Where the arm was told to be, where its encoders saw it, and where the estimator puts it; "
            "the curves should lie on each other. "
            "A lasting distance between desired and measured is the give of the controller under the load, "
            "not an error of the weighing.",
        ),
        (
            "Speeds",
            speeds,
            ("rad/s", "m/s"),
            "v",
            "The estimated speed should follow the desired one with little noise: noise here enters the torques. "
            "The weighing is at its best once all speeds have settled at zero.",
        ),
    ):
        if not curves or not n:
            continue
        notes = _tracking(curves, [_unit(report, j, *units) for j in range(n)])

        def build(
            j: int,
            curves: dict[str, Array] = curves,
            units: tuple[str, str] = units,
            quantity: str = heading.lower().removesuffix("s"),
            notes: list[str] | None = notes,
        ) -> Figure:
            return joints_figure(
                report.time_s,
                {name: v[:, j : j + 1] for name, v in curves.items()},
                [report.joint_names[j]],
                quantity=quantity,
                unit=_unit(report, j, *units),
                notes=None if notes is None else [notes[j]],
                columns=1,
                key=False,
                points=points,
            )

        key = _page.key([_KEYS[name] for name in curves])
        sections.append(
            _page.section(
                heading, key, panels(report.joint_names, build, heading.lower(), prefix), _page.read(text)
            )
        )
    if torque is not None and n:
        sections.append(_torques(report, torque, points))
    if effort is not None and n:
        sections.append(_efforts(report, effort, points))
    return sections


def _tracking(curves: dict[str, Array], units: Sequence[str]) -> list[str] | None:
    """Rms distance of each joint from where it should be."""
    actual = next((curves[name] for name in ("measured", "estimated") if name in curves), None)
    if actual is None or "desired" not in curves:
        return None
    notes = []
    for j, unit in enumerate(units):
        away = (actual - curves["desired"])[:, j]
        away = away[np.isfinite(away)]
        rms = math.sqrt(float(np.mean(np.square(away)))) if away.size else math.nan
        notes.append(f"off by {number(rms, 2)} {unit} rms" if away.size else "no value")
    return notes


def _torques(report: WeighReport, torque: Array, points: int) -> str:
    std = report.external_torque_std

    def build(j: int) -> Figure:
        return torque_figure(
            report.time_s,
            torque[:, j : j + 1],
            None if std is None else std[:, j : j + 1],
            [report.joint_names[j]],
            unit=_unit(report, j, "N m", "N"),
            columns=1,
            key=False,
            points=points,
        )

    key = [("estimated", "blue", "line")]
    if std is not None:
        key.append(("± 2 standard deviations", "blue", "area"))
    text = (
        "What the surroundings do to each joint, found without a force sensor: τ_ext is positive when the environment "
        "pushes the robot in the joint's positive direction, so a held object shows with the sign of its weight. "
        "A joint whose shade includes zero feels nothing it could be sure of; arrows name values beyond the scale."
    )
    figures = panels(report.joint_names, build, "external torque", "e")
    return _page.section("External torques", _page.key(key), figures, _page.read(text))


def _efforts(report: WeighReport, effort: Array, points: int) -> str:
    def build(j: int) -> Figure:
        return joints_figure(
            report.time_s,
            {"measured": effort[:, j : j + 1]},
            [report.joint_names[j]],
            quantity="effort",
            unit=report.effort_unit,
            columns=1,
            key=False,
            points=points,
        )

    text = (
        "What the drives reported, before any conversion: this and the positions are all the weighing needs. "
        "The number holds gravity and friction of the arm as well as the load."
    )
    return _page.section(
        "Motor effort",
        _page.key([_KEYS["measured"]]),
        panels(report.joint_names, build, "motor effort", "m"),
        _page.read(text),
    )


def _error(report: WeighReport) -> str:
    z = normalised_error(report)
    z = z[np.isfinite(z)]
    if not z.size:
        return ""
    inside = 100.0 * float(np.mean(np.abs(z) <= TWO_SIDED_95))
    text = (
        f"The error in units of its own stated standard deviation σ, where the status is ok: {inside:.1f} % of these "
        f"{z.size} samples lie inside the 95 % band. "
        "Neighbouring samples share their error, so one run strays for a while or not at all; "
        "what lies beyond ± 6 is drawn at the edge."
    )
    figures = _both(
        lambda narrow: error_figure(report, narrow=narrow), "error in standard deviations", "error"
    )
    return _page.section("Is the stated uncertainty true?", figures, _page.read(text))
