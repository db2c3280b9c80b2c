"""The built-in estimators: names in scenarios and files, and codes in the compiled laws."""

from __future__ import annotations

from typing import Literal, get_args

EstimatorKind = Literal["ekf", "ekf-slip", "truth"]
ESTIMATOR_KINDS: tuple[EstimatorKind, ...] = get_args(EstimatorKind)

EKF, TRUTH, EXTERNAL, EKF_SLIP = range(4)  # EXTERNAL: the user's Python object
ESTIMATOR_CODES: dict[str, int] = {"ekf": EKF, "ekf-slip": EKF_SLIP, "truth": TRUTH}
