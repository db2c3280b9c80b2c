"""Numbers of the random streams. A number, once given, is never given again: it is part of a result."""

POSITION_NOISE = 1
START_POSE = 2
