"""What runs on each robot, from what the robot can know: encoders, fixes and messages.

At the sensor rate encoders, position fix, EKF and wheel loop; at the control period radio, observer and
tracking law. No true state and no reward.
"""
