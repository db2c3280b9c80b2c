"""Steps per second, compared with other environments."""
