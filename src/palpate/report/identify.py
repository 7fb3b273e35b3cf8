"""The report on one identification: a single HTML file, from the residual in large type down to every "
"parameter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import _files, _page
from ._series import Array
from ._style import LIGHT, drawing, svg
from ._text import clean, escape, number, rounded
from .figures import _axes, _figure, joints_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from palpate.identify import Estimate, Fit, GainFit, Prediction, Residuals

_POINTS = 30_000
"""shared by all curves of a section"""
_BANDS = 60
"""points of a spectrum, evenly spaced on its logarithmic axis"""
TRUSTED = 0.1
"""a base parameter is called known with a standard deviation below this part of its value"""


def write_identify_report(
    fit: Fit,
    predictions: Mapping[str, Prediction],
    path: str | PathLike[str],
    *,
    title: str = "Identification",
    gains: GainFit | None = None,
    remarks: Sequence[str] = (),
    provenance: Sequence[str] = (),
) -> Path:
    """Write one self-contained HTML file; the same bytes for the same data.

    Args:
        fit: what was found.
        predictions: torques of logs by the logs' names, of :meth:`palpate.identify.Fit.predict`.
        path: file to write.
        title: heading.
        gains: where the gains were identified, too.
        remarks: sentences that must not be missed, shown above the figures.
        provenance: where the numbers come from, line by line.

    Raises:
        InputError: the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    with drawing():
        sections = [_header(fit, title), _card(fit)]
        if remarks or fit.unseen:
            sections.append(_page.section("Remarks", _page.lines([*fit.unseen, *remarks])))
        sections.append(_residuals(fit))
        if gains is not None:
            sections.append(_gains(fit, gains))
        for index, (name, prediction) in enumerate(predictions.items()):
            sections.append(_torques(fit, name, prediction, index, len(predictions)))
        for index, (name, prediction) in enumerate(predictions.items()):
            sections.append(_spectra(fit, name, prediction, index))
        sections += [_friction(fit), _links(fit), _base(fit)]
        if provenance:
            sections.append(_page.section("Where this comes from", _page.lines(provenance)))
        sections.append(
            "<footer>Torque is on the link side and includes gravity and friction. “±” is half of the 95 % "
            "interval "
            "(1.96 standard deviations σ); σ counts the memory of the residual, so that neighbouring "
            "samples are not "
            "taken for independent ones. SI units. Written by palpate identify.</footer>"
        )
    return _files.write(path, _page.page(title, (s for s in sections if s)))


def _header(fit: Fit, title: str) -> str:
    logs = len(fit.origins)
    parts = [
        fit.arm.name,
        f"{fit.arm.n} joints",
        f"{logs} log" + ("s" if logs > 1 else ""),
        f"{fit.residuals.rows} rows per joint, low-passed at {number(fit.cutoff, 3)} Hz",
        f"{fit.method} fit",
    ]
    return f'<header><h1>{escape(title)}</h1><p class="sub">{escape(" · ".join(parts))}</p></header>'


def _card(fit: Fit) -> str:
    shown = fit.held_out or fit.residuals
    what = f"of the torque left unexplained: {shown.what}"
    known = trusted(fit)
    tone = "green" if not fit.blind and fit.base.rank == fit.base.structural_rank else "orange"
    seen = f"{fit.base.rank} of {fit.base.structural_rank} base parameters seen"
    facts = [
        ("residual, the fit's own data", f"{number(100.0 * fit.residuals.relative_overall, 3)} %", ""),
        ("RMS over all joints", f"{number(shown.overall, 3)} N m", shown.what),
        (
            "base parameters known",
            f"{sum(known)} of {fit.base.structural_rank}",
            f"σ below {TRUSTED:.0%} of the value",
        ),
        ("conditioning", number(fit.base.conditioning, 3), "of the base regressor"),
    ]
    items = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}{f'<small>{escape(more)}</small>' if more else ''}</dd></div>"
        for name, value, more in facts
    )
    return (
        '<div class="card"><div class="words">'
        f'<div class="number">{number(100.0 * shown.relative_overall, 3)} <small>%</small></div>'
        f'<p class="read">{escape(what)}</p>'
        f'<p><span class="pill" style="--tone:var(--{tone})">{escape(seen)}</span></p>'
        f'<dl class="facts">{items}</dl></div></div>'
    )


def trusted(fit: Fit) -> list[bool]:
    """Which base parameters are known to better than :data:`TRUSTED` of their value."""
    return [bool(std < TRUSTED * abs(value)) for value, std in zip(fit.base.value, fit.base.std, strict=True)]


def _residuals(fit: Fit) -> str:
    columns: list[tuple[str, Residuals]] = [("the fit's own data", fit.residuals)]
    if fit.held_out is not None:
        columns.append((fit.held_out.what, fit.held_out))
    head = ["joint"]
    for what, _ in columns:
        head += [f"{what}: RMS [N m]", "of the torque"]
    rows = [
        [
            escape(joint.name),
            *(
                cell
                for _, r in columns
                for cell in (number(float(r.rms[j]), 3), f"{number(100.0 * float(r.relative[j]), 3)} %")
            ),
        ]
        for j, joint in enumerate(fit.arm.joints)
    ]
    rows.append(
        [
            "all",
            *(
                cell
                for _, r in columns
                for cell in (number(r.overall, 3), f"{number(100.0 * r.relative_overall, 3)} %")
            ),
        ]
    )
    text = (
        "What the model leaves unexplained. The second pair of columns is what to expect of new motion; "
        "where it is much "
        "larger than the first, the motion was too short or too uniform."
    )
    return _page.section(
        "Residuals", _page.table(head, rows, frozenset(range(1, len(head)))), _page.read(text)
    )


def _gains(fit: Fit, gains: GainFit) -> str:
    rows = [
        [escape(j.name), *_pair(float(k), float(s)), f"{number(100.0 * float(s / k), 2)} %"]
        for j, k, s in zip(fit.arm.joints, gains.gain, gains.std, strict=True)
    ]
    note = _page.read(
        "Found together with the dynamics from motion with and without the known load. Known worst: "
        f"{gains.weakest}."
    )
    table = _page.table(("joint", "gain [N m/A]", "±", "σ"), rows, frozenset((1, 2, 3)))
    return _page.section("Drive gains", table, note)


def _pair(value: float, std: float) -> tuple[str, str]:
    return rounded(value, 1.96 * std)


def _torques(fit: Fit, name: str, prediction: Prediction, index: int, count: int) -> str:
    points = min(max(_POINTS // (3 * fit.arm.n * max(count, 1)), 150), 900)
    panels = []
    for j, joint in enumerate(fit.arm.joints):
        # before a joint's first motion its friction is anyone's guess
        known = prediction.known[:, j]
        predicted = np.where(known, prediction.predicted[:, j], np.nan)
        error = prediction.measured[:, j] - predicted
        rms = float(np.sqrt(np.mean(np.square(error[known])))) if known.any() else math.nan
        figure = joints_figure(
            prediction.time,
            {
                "measured": prediction.measured[:, j : j + 1],
                "estimated": predicted[:, None],
                "residual": error[:, None],
            },
            [joint.name],
            quantity="torque",
            unit="N m" if joint.kind == "revolute" else "N",
            notes=[f"off by {number(rms, 2)} rms"],
            columns=1,
            key=False,
            points=points,
        )
        panels.append(f"<figure>{svg(figure, f'torque of {clean(joint.name, 60)}', f't{index}{j}')}</figure>")
    key = _page.key(
        [("measured", "grey", "line"), ("predicted", "blue", "line"), ("difference", "orange", "line")]
    )
    text = (
        "Measured torque (effort times gain) and what the identified arm predicts from positions and velocities "
        "alone; nothing is predicted before a joint's first motion, when its friction is unknown. The difference "
        "should look like noise about zero; a shape that repeats with the motion is dynamics the model lacks, a step "
        "at each reversal is friction."
    )
    return _page.section(
        f"Torques: {name}", key, f'<div class="panels">{"".join(panels)}</div>', _page.read(text)
    )


def _spectra(fit: Fit, name: str, prediction: Prediction, index: int) -> str:
    spectra = _welch(prediction, fit.cutoff)
    if spectra is None:
        return ""
    frequency, measured, residual = spectra
    panels = []
    for j, joint in enumerate(fit.arm.joints):
        figure = _spectrum(frequency, measured[:, j], residual[:, j], joint.name)
        panels.append(
            f"<figure>{svg(figure, f'residual spectrum of {clean(joint.name, 60)}', f's{index}{j}')}</figure>"
        )
    key = _page.key([("measured torque", "grey", "line"), ("residual", "orange", "line")])
    text = (
        "Amplitude densities of the measured torque and of what is left of it. Below the band of the "
        "motion the residual "
        "is friction that changes with temperature and time; a peak is a gear or a flexible mode; where "
        "the curves meet "
        "the model explains nothing."
    )
    return _page.section(
        f"Residual spectra: {name}", key, f'<div class="panels">{"".join(panels)}</div>', _page.read(text)
    )


def _welch(prediction: Prediction, cutoff: float) -> tuple[Array, Array, Array] | None:
    """Frequencies (K,) [Hz] and amplitude densities (K, n) [N m/sqrt(Hz)] of torque and residual."""
    from scipy.signal import welch

    time = prediction.time
    if len(time) < 64:
        return None
    period = float(np.median(np.diff(time)))
    # before its first motion a joint's friction is unknown
    known = np.all(prediction.known[:, np.any(prediction.known, axis=0)], axis=1).reshape(-1)
    broken = (np.abs(np.diff(time) - period) > 0.5 * period) | (np.diff(known.astype(int)) != 0)
    parts = np.split(np.arange(len(time)), np.flatnonzero(broken) + 1)
    longest = max((part for part in parts if known[part[0]]), key=len, default=parts[0])
    if len(longest) < 64:
        return None
    length = min(len(longest), max(64, round(10.0 / period)))
    found = [
        welch(values[longest], 1.0 / period, nperseg=length, detrend="constant", axis=0)
        for values in (prediction.measured, prediction.measured - prediction.predicted)
    ]
    frequency = found[0][0]
    inside = (frequency > 0.0) & (frequency <= 1.5 * cutoff)
    edges = np.geomspace(frequency[inside][0], frequency[inside][-1] * 1.0001, _BANDS)
    place = np.digitize(frequency[inside], edges)
    keep = np.unique(place)

    def grouped(density: Array) -> Array:
        return np.sqrt(np.array([density[inside][place == k].mean(axis=0) for k in keep]))

    middle = np.array([frequency[inside][place == k].mean() for k in keep])
    return middle, grouped(found[0][1]), grouped(found[1][1])


def _spectrum(frequency: Array, measured: Array, residual: Array, name: str) -> Figure:
    wide, high = 3.4, 1.72
    figure = _figure(wide, high + 0.02)
    ax = _axes(figure, 0.58, 0.4, wide - 0.66, high - 0.66)
    floor = 1e-6 * max(float(measured.max()), 1e-12)
    ax.loglog(frequency, np.maximum(measured, floor), color=LIGHT["grey"], linewidth=2.0)
    ax.loglog(frequency, np.maximum(residual, floor), color=LIGHT["orange"], linewidth=1.1)
    ax.set_xlim(float(frequency[0]), float(frequency[-1]))
    ax.set_title(clean(name, 36), loc="left", y=1.0, parse_math=False)
    ax.set_xlabel("frequency [Hz]", labelpad=1.0)
    ax.set_ylabel("N m/√Hz")
    from matplotlib.ticker import FuncFormatter, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(plain)
        axis.set_minor_formatter(NullFormatter())
    ax.minorticks_off()
    return figure


def _by_name(fit: Fit) -> dict[str, Estimate]:
    return {e.name: e for e in fit.parameters}


def source(estimate: Estimate) -> str:
    """Who says so: the data, the prior, or both."""
    if math.isnan(estimate.seen) or estimate.seen >= 0.9:
        return "data"
    return "data and prior" if estimate.seen >= 0.5 else "prior"


def _unit(unit: str) -> str:
    return unit.replace("^2", "²")


def _friction(fit: Fit) -> str:
    named = _by_name(fit)
    terms = [*fit.friction.terms, *(["rotor_inertia"] if fit.friction.rotor_inertia else [])]
    units = {e.name.rpartition(".")[2]: e.unit for e in fit.parameters}
    rows = []
    for j, joint in enumerate(fit.arm.joints):
        cells = []
        for term in terms:
            e = named[f"{joint.name}.{term}"]
            value, half = _pair(e.value, e.std)
            text = f"{value} ± {half}" + ("" if source(e) == "data" else f" ({source(e)})")
            cells.append("not seen" if j in fit.blind else escape(text))
        cells.append(number(fit.shape.presliding[j], 2))
        rows.append([escape(joint.name), *cells])
    for coupling in fit.friction.couplings:
        name = "+".join(fit.arm.joints[j].name for j in coupling.joints)
        for term in ("coulomb", "viscous", "rotor_inertia"):
            e = named[f"{name}.{term}"]
            value, half = _pair(e.value, e.std)
            rows.append([escape(f"{name}: {term}"), f"{value} ± {half}", *[""] * len(terms)])
    head = ["joint", *(f"{t.replace('_', ' ')} [{_unit(units[t])}]" for t in terms), "presliding [rad]"]
    note = _page.read(
        "“(prior)” marks what this motion tells less about than was supposed before. Friction drifts by a "
        "tenth and more "
        "with temperature: the interval is that of these logs."
    )
    return _page.section("Friction and rotors", _page.table(head, rows, frozenset(range(1, len(head)))), note)


def _links(fit: Fit) -> str:
    named = _by_name(fit)
    rows = []
    for i, joint in enumerate(fit.arm.joints):
        mass = named[f"{joint.link}.m"]
        value, half = _pair(mass.value, mass.std)
        before = fit.start.joints[i].mass
        inertia = np.linalg.eigvalsh(joint.inertia)
        rows.append(
            [
                escape(joint.link),
                number(before, 3) if before > 0.0 else "–",
                f"{value} ± {half}",
                f"{mass.seen:.0%}",
                escape(", ".join(number(float(c), 3) for c in joint.com)),
                escape(", ".join(number(float(v), 2) for v in inertia)),
            ]
        )
    head = ("link", "before [kg]", "mass [kg]", "seen", "centre of mass [m]", "principal moments [kg m²]")
    note = _page.read(
        "No motion tells a link's ten parameters apart: only combinations of them act on the torques (the "
        "base parameters "
        "below). The links here are the possible bodies nearest to the prior with those combinations; "
        "“seen” is the part "
        "of what is known of the mass that the data say."
    )
    return _page.section("Links", _page.table(head, rows, frozenset((1, 2, 3, 4, 5))), note)


def _base(fit: Fit) -> str:
    rows = []
    for name, value, std, good, at in zip(
        fit.base.names, fit.base.value, fit.base.std, trusted(fit), fit.base.index, strict=True
    ):
        unit = fit.parameters[at].unit
        text, half = _pair(float(value), float(std))
        relative = float(std) / abs(float(value)) if value else math.inf
        if good:
            verdict = '<span class="yes">known</span>'
        elif relative < 0.5:
            verdict = "roughly"
        else:
            verdict = "not told from 0"
        share = f"{number(100.0 * relative, 2)} %" if relative < 10.0 else "> 1000 %"
        rows.append([escape(name), f"{text} ± {half}", escape(_unit(unit)), share, verdict])
    head = ("led by", "value", "unit", "σ / value", "")
    note = _page.read(
        "What the data alone say, by weighted least squares: each is its leading parameter plus the "
        "combination of others "
        "that cannot be told from it."
    )
    return _page.section("Base parameters", _page.table(head, rows, frozenset((1, 3))), note)
