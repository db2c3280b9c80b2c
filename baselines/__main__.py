"""The command line as ``python -m baselines``."""

from __future__ import annotations

from baselines.cli import main

if __name__ == "__main__":
    main()
