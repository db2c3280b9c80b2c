"""The robots as bodies: parameters, friction laws, the wheel kernel and the plants.

The inputs are torques and floors. Nothing here depends on references, estimates or rewards.
"""
