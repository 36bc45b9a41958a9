"""Equations of the diffusion Kalman filter, whose P is no bound on its error."""

from __future__ import annotations

from netkf.checks.kalman_consensus import EquationChecks

CHECKS = EquationChecks()
