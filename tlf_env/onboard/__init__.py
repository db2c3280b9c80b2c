"""What runs on each robot: sensors, EKF and wheel loop at the sensor rate; radio, observer and tracking law
at the control period. Knows encoders, fixes and messages; knows no true state and no reward.
"""
