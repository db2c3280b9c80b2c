"""Software on board of each robot; its inputs are encoders, position fixes and messages.

At the physics period: encoders, position fix, EKF and wheel loop. At the control period: radio, observer
and tracking law. It has no access to the true state or the reward.
"""
