"""Steps per second, beside other environments."""
