"""Shared code without compiled laws: frozen models, presets, files, error messages."""
