"""Names in scenarios and files: the default controller, the built-in estimators and their codes in the laws."""

from __future__ import annotations

from typing import Literal, get_args

DEFAULT_CONTROLLER = "linearised"  # a preset in configs/controllers

EstimatorKind = Literal["ekf", "ekf-slip", "ekf-gyro", "truth"]
ESTIMATOR_KINDS: tuple[EstimatorKind, ...] = get_args(EstimatorKind)

EKF, TRUTH, EXTERNAL, EKF_SLIP, EKF_GYRO = range(5)  # EXTERNAL: the user's Python object
ESTIMATOR_CODES: dict[str, int] = {
    "ekf": EKF,
    "ekf-slip": EKF_SLIP,
    "ekf-gyro": EKF_GYRO,
    "truth": TRUTH,
}
