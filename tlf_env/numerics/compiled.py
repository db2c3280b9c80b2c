"""How the laws and the step drivers are compiled, and where the result is kept.

A *law* is a scalar function (floats and named tuples of floats in, the same out). It is inlined into
whatever calls it, so that a law exists once and costs no call. A *driver* works on arrays. Python calls
it, and it is cached on disk.

Numba's own cache looks only at the file that holds a function, not at the files which that function
imports from. Here the folder of the cache is named by a hash over every source that can hold a law,
so that an edit anywhere gives a new folder. The folder lies in the user's cache, never beside the
sources: an installation may be read-only.
"""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import platformdirs
from numba.core import types
from numba.core.cgutils import create_struct_proxy
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic

F = TypeVar("F", bound=Callable[..., Any])

PACKAGE = Path(__file__).resolve().parent.parent
ROOMS_WITH_LAWS = ("numerics", "physics", "onboard", "disturbances", "task", "engine")


if hasattr(os, "register_at_fork"):
    # A child has only the thread that forked: a lock that another one held would stay locked for ever.
    # So a fork waits until no other thread compiles.
    os.register_at_fork(
        before=global_compiler_lock.acquire,
        after_in_parent=global_compiler_lock.release,
        after_in_child=global_compiler_lock.release,
    )


@functools.cache
def sources_digest() -> str:
    """Hexadecimal digest of every source file that can hold a law, in a fixed order."""
    digest = hashlib.sha256(numba.__version__.encode())
    for room in ROOMS_WITH_LAWS:
        for path in sorted((PACKAGE / room).glob("*.py")):
            digest.update(f"{room}/{path.name}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:20]


@functools.cache
def cache_folder() -> Path:
    """Folder of the compiled drivers; ``TLF_ENV_CACHE`` names another parent.

    Falls back to a private folder below the system's temporary one where the user's cache cannot be
    written, so that a driver is compiled once per machine and not once per process.
    """
    parent = os.environ.get("TLF_ENV_CACHE") or platformdirs.user_cache_dir("tlf_env")
    folder = Path(parent) / sources_digest()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        folder = _temporary_folder() / sources_digest()
        folder.mkdir(mode=0o700, exist_ok=True)
        return folder


def _temporary_folder() -> Path:
    """A folder of this user alone below the system's temporary one: a cache holds code."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"tlf_env-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.stat(follow_symlinks=False)
    mine = not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o022
    )
    return folder if mine and not folder.is_symlink() else Path(tempfile.mkdtemp(prefix="tlf_env-"))


def law(function: F) -> F:
    """Compile a scalar law so that it is inlined into its callers.

    Division by zero gives infinity as in NumPy (no branch per division), and no fast-math: two
    drivers that inline the same law must agree to the last bit.

    Laws and blocks do not count references to their array arguments: the caller holds the arrays, and a
    count is an atomic write that threads would wait for. So they make no arrays, only views.
    """
    compiled: F = numba.njit(error_model="numpy", forceinline=True, nogil=True, _nrt=False)(
        function
    )
    return compiled


def block(function: F) -> F:
    """Compile a larger law that is called rather than inlined, to keep compile times short.

    A call copies the whole tuple of arrays, so that a block is best a loop over robots or lanes.
    """
    compiled: F = numba.njit(error_model="numpy", nogil=True, _nrt=False)(function)
    return compiled


def view(function: F) -> F:
    """Compile a function that returns a view of an array, into its callers' own source."""
    compiled: F = numba.njit(error_model="numpy", nogil=True, inline="always")(function)
    return compiled


def allocating(function: F) -> F:
    """Compile a short function that makes an array and passes it to a block."""
    compiled: F = numba.njit(error_model="numpy", forceinline=True, nogil=True)(function)
    return compiled


def driver(function: F) -> F:
    """Compile a function over arrays, and keep the result on disk."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_folder())  # read when the cache object is made, just below
    try:
        compiled: F = numba.njit(error_model="numpy", nogil=True, cache=True)(function)
    finally:
        numba.config.CACHE_DIR = before
    return compiled


@intrinsic
def fetch_add(typing: Any, numbers: Any, amount: Any) -> Any:
    """Add to an array's first whole number and return its old value, atomically."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        array = create_struct_proxy(signature.args[0])(context, builder, value=values[0])
        return builder.atomic_rmw("add", array.data, values[1], "monotonic")

    return types.int64(numbers, types.int64), build
