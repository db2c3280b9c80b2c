"""What every room shares and nothing compiled depends on: frozen models, presets, files, errors."""
