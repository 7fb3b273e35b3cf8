"""A job's result for machines and for people."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from ..report import WipeReport
from .film import shown
from .options import JobOptions
from .result import JobResult, Look
from .scene import BoardScene

BAND = 0.5, 1.0
"""half width within which the normal force should stay [N]: up to SLOW, and above"""
SLOW = 0.15
"""[m/s]"""
_SHOWN = (720, 405)
"""width and height of a picture in the report [pixels]"""


def band(options: JobOptions) -> float:
    """Half width within which the normal force should stay at the speed asked for [N]."""
    return BAND[0] if options.speed <= SLOW else BAND[1]


def summary(result: JobResult, options: JobOptions) -> dict[str, Any]:
    """The result in plain numbers, fit for JSON; what does not exist is None."""
    track = result.track
    return {
        "verdict": result.verdict,
        "reason": result.reason,
        "resumable": result.resumable,
        "passes": len(result.passes),
        "ink_before_m2": _plain(result.ink_before),
        "ink_after_m2": _plain(result.ink_after),
        "ink_left": _plain(result.ink_left),
        "within_band": _plain(track.within(band(options))),
        "band_N": band(options),
        "max_commanded_force_N": _largest(track.force),
        "max_commanded_moment_Nm": _largest(track.moment),
        "max_contact_force_N": _largest(track.contact),
        "max_board_moved_m": _largest(track.moved),
        "simulated_s": _plain(result.simulated),
        "wall_s": _plain(result.wall),
        "timing_s": {
            name: {"period": t.period, "cycles": t.cycles, "median": _plain(t.median), "p99": _plain(t.p99)}
            for name, t in result.timing.items()
        },
        "events": [
            {"t": round(e.time_ns * 1e-9, 3), "kind": e.kind, "text": e.text}
            for e in result.events
            if e.kind != "activity"
        ],
    }


def report(result: JobResult, options: JobOptions, scene: BoardScene, title: str) -> WipeReport:
    """What :func:`palpate.report.write_wipe_report` writes."""
    track = result.track
    setting = scene.setting
    return WipeReport(
        title=title,
        arm=f"{scene.arms[0].name} wipes, {scene.arms[1].name} holds",
        verdict=result.verdict,
        reason=result.reason,
        ink_before=result.ink_before,
        ink_after=result.ink_after,
        simulated=result.simulated,
        wall=result.wall,
        max_force=options.max_force,
        max_torque=options.max_torque,
        band=band(options),
        time_s=track.time,
        phase=track.phase,
        wanted=track.wanted,
        estimated=track.estimated,
        normal=track.normal,
        contact=track.contact,
        force=track.force,
        moment=track.moment,
        tool=track.tool,
        moved=track.moved,
        yielding=track.yielding,
        size=scene.ink.size,
        coverage=result.coverage,
        before=_jpeg(result.before),
        after=None if result.after is result.before else _jpeg(result.after),
        passes=[
            {
                "pass": str(k + 1),
                "from": f"{p.begin_ns * 1e-9:.1f} s",
                "took": f"{(p.end_ns - p.begin_ns) * 1e-9:.1f} s",
                "way": p.plan.summary,
                "ink at its beginning": f"{1e4 * p.ink:.2f} cm²",
                "seen": f"{100.0 * p.seen:.2f} % of the surface",
            }
            for k, p in enumerate(result.passes)
        ],
        events=[(e.time_ns * 1e-9, e.kind, e.text) for e in result.events if e.kind != "activity"],
        timing=[
            {
                "activity": name,
                "period": f"{1e3 * t.period:g} ms",
                "cycles": str(t.cycles),
                "median": _milli(t.median),
                "99 %": _milli(t.p99),
                "worst": _milli(t.worst),
            }
            for name, t in result.timing.items()
        ],
        limited=options.limited,
        settings={
            "speed": f"{options.speed:g} m/s",
            "normal force": f"{options.normal_force:g} N",
            "passes at most": options.passes,
            "board held": options.hold,
            "only colours": "all" if options.colour is None else ", ".join(options.colour),
            "only within": "the whole board" if options.within is None else str(options.within),
            "nothing within": "–" if options.without is None else str(options.without),
            "board": f"{scene.ink.size[0]:.3f} m x {scene.ink.size[1]:.3f} m, {setting.mass:.2f} kg",
            "table tilted by": f"{math.degrees(setting.tilt):.1f}°",
            "magnets": len(setting.magnets),
            "seed": options.seed,
        },
    )


def _jpeg(look: Look | None) -> bytes | None:
    if look is None:
        return None
    return cv2.imencode(".jpg", shown(look, _SHOWN), [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def _milli(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def _largest(values: np.ndarray) -> float | None:
    good = values[np.isfinite(values)]
    return _plain(float(good.max())) if good.size else None


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None
