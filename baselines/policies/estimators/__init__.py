"""Estimators in Python: an unscented Kalman filter and a moving-horizon estimator of the same model."""
