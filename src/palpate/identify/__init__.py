"""Identification: from logs to dynamics, friction, drive gains and loads (MATH.md section 6)."""

from palpate.identify.data import RegressionData, prepare
from palpate.identify.fit import Estimate, Fit, Prediction, Residuals, fit
from palpate.identify.friction import Coupling, FrictionModel, FrictionShape

__all__ = [
    "Coupling",
    "Estimate",
    "Fit",
    "FrictionModel",
    "FrictionShape",
    "Prediction",
    "RegressionData",
    "Residuals",
    "fit",
    "prepare",
]
