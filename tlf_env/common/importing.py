"""What is done once another package is imported, so that it need not be imported for it.

Registering the tasks is all that ``import tlf_env`` needs Gymnasium and PettingZoo for, and their imports
take longer than all else that lists names or completes them in a shell.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class _Finder(MetaPathFinder):
    """Finds a package as the other finders do, and has the action done when it has been imported."""

    def __init__(self, package: str, action: Callable[[], None]) -> None:
        self.package, self.action = package, action

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The package's spec, whose loader does the action at its end; None for any other name."""
        if name != self.package:
            return None
        others = (one for one in sys.meta_path if not isinstance(one, _Finder))
        specs = (one.find_spec(name, path, target) for one in others)
        spec = next((one for one in specs if one is not None), None)
        if spec is None or spec.loader is None:
            return None
        loader = spec.loader
        load = loader.exec_module

        def load_and_act(module: ModuleType) -> None:
            del loader.exec_module
            load(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
                self.action()

        # Set on the one loader, which stays the package's: it also reads the package's files.
        loader.exec_module = load_and_act  # type: ignore[method-assign]
        return spec


def when_imported(package: str, action: Callable[[], None]) -> None:
    """Do something as soon as a package of the top level has been imported; at once, if it is already."""
    if package in sys.modules:
        action()
    else:
        sys.meta_path.insert(0, _Finder(package, action))
