"""The command line as ``tlf`` and as ``python -m baselines``."""

from __future__ import annotations

import signal


def main() -> None:
    """Run the command line. An interrupt while its modules are imported ends it without a traceback."""
    usual = signal.getsignal(signal.SIGINT)
    is_pythons = usual is signal.default_int_handler
    if is_pythons:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from baselines.cli import main as run

    if is_pythons:
        signal.signal(signal.SIGINT, usual)
    run()


if __name__ == "__main__":
    main()
