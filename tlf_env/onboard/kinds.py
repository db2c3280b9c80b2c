"""The built-in estimators: names in scenarios and files, and codes in the compiled laws."""

from __future__ import annotations

from typing import Literal, get_args

EstimatorKind = Literal["ekf", "ekf-slip", "ekf-gyro", "truth"]
ESTIMATOR_KINDS: tuple[EstimatorKind, ...] = get_args(EstimatorKind)

EKF, TRUTH, EXTERNAL, EKF_SLIP, EKF_GYRO = range(5)  # EXTERNAL: the user's Python object
ESTIMATOR_CODES: dict[str, int] = {
    "ekf": EKF,
    "ekf-slip": EKF_SLIP,
    "ekf-gyro": EKF_GYRO,
    "truth": TRUTH,
}
