"""Identification: from logs to dynamics, friction, drive gains and loads (MATH.md section 6).

Functions from data to frozen results; nothing is printed, plotted or written. Needs the extra ``identify``.
"""

from palpate.identify.cad import Body, mesh_body, printed_complaint, with_meshes
from palpate.identify.currents import (
    PhaseCalibration,
    TorqueConstants,
    calibrate_phases,
    fit_torque_constants,
)
from palpate.identify.data import RegressionData, prepare
from palpate.identify.excitation import Excitation, excite, to_csv, to_ros
from palpate.identify.fitting import Estimate, Fit, Prediction, Residuals, fit
from palpate.identify.friction import Coupling, FrictionModel, FrictionShape
from palpate.identify.gains import GainFit, KnownLoad, fit_gains
from palpate.identify.load import LoadEstimate, estimate_load
from palpate.identify.servo import BusDrive, fit_bus_drive
from palpate.identify.transmission import TransmissionFit, fit_transmission

__all__ = [
    "Body",
    "BusDrive",
    "Coupling",
    "Estimate",
    "Excitation",
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
    "excite",
    "fit",
    "fit_bus_drive",
    "fit_gains",
    "fit_torque_constants",
    "fit_transmission",
    "mesh_body",
    "prepare",
    "printed_complaint",
    "to_csv",
    "to_ros",
    "with_meshes",
]
