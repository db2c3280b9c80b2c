"""The robots as bodies: parameters, friction laws, the wheel kernel and the plants.

Knows torques and floors; knows no reference, no estimate and no reward.
"""
