"""Logs of robot arms: open, check, slice, record, save."""

from palpate.logs.columns import ColumnMap, SignalColumns
from palpate.logs.formats import open_known, read_bam, read_motor_pair, read_tx40
from palpate.logs.log import Event, Log, Sample, Signal
from palpate.logs.recorder import Recorder
from palpate.logs.repair import Clock, RepairReport

__all__ = [
    "Clock",
    "ColumnMap",
    "Event",
    "Log",
    "Recorder",
    "RepairReport",
    "Sample",
    "Signal",
    "SignalColumns",
    "open_known",
    "read_bam",
    "read_motor_pair",
    "read_tx40",
]
