"""Tracking laws: from the ``tracking`` observation to the twist that a robot should have, before limits."""
