"""Identification: from logs to dynamics, friction, drive gains and loads (MATH.md section 6).

Functions from data to frozen results; nothing is printed, plotted or written. Needs the extra ``identify``.
"""

from palpate.identify.currents import (
    PhaseCalibration,
    TorqueConstants,
    calibrate_phases,
    fit_torque_constants,
)
from palpate.identify.data import RegressionData, prepare
from palpate.identify.fitting import Estimate, Fit, Prediction, Residuals, fit
from palpate.identify.friction import Coupling, FrictionModel, FrictionShape
from palpate.identify.gains import GainFit, KnownLoad, fit_gains
from palpate.identify.load import LoadEstimate, estimate_load
from palpate.identify.servo import BusDrive, fit_bus_drive
from palpate.identify.transmission import TransmissionFit, fit_transmission

__all__ = [
    "BusDrive",
    "Coupling",
    "Estimate",
    "Fit",
    "FrictionModel",
    "FrictionShape",
    "GainFit",
    "KnownLoad",
    "LoadEstimate",
    "PhaseCalibration",
    "Prediction",
    "RegressionData",
    "Residuals",
    "TorqueConstants",
    "TransmissionFit",
    "calibrate_phases",
    "estimate_load",
    "fit",
    "fit_bus_drive",
    "fit_gains",
    "fit_torque_constants",
    "fit_transmission",
    "prepare",
]
