"""Compilation, random numbers and angles; nothing here depends on robots."""
