"""Reports and figures: self-contained HTML, Markdown, JSON, PNG. Figures need ``palpate[report]``."""

from __future__ import annotations

from ._style import encode_png
from .feel import FeelReport, write_feel_report
from .figures import (
    coverage_figure,
    error_figure,
    hero_picture,
    joints_figure,
    mass_figure,
    save_png,
    table_figure,
    torque_figure,
)
from .identify import write_identify_report
from .study import StudyFiles, StudyRow, markdown_table, update_markdown, write_study
from .weigh import write_weigh_report
from .weighing import WeighReport
from .wipe import WipeReport, write_wipe_report

__all__ = [
    "FeelReport",
    "StudyFiles",
    "StudyRow",
    "WeighReport",
    "WipeReport",
    "coverage_figure",
    "encode_png",
    "error_figure",
    "hero_picture",
    "joints_figure",
    "markdown_table",
    "mass_figure",
    "save_png",
    "table_figure",
    "torque_figure",
    "update_markdown",
    "write_feel_report",
    "write_identify_report",
    "write_study",
    "write_weigh_report",
    "write_wipe_report",
]
