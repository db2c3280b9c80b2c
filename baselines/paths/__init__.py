"""Paths of a user's own: logs in any usual form, smoothed and timed so that a robot can follow them."""
