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
import gc
import hashlib
import os
import pickle
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from typing import Any, TypeVar

import llvmlite.binding as llvm
import numba
import platformdirs
from numba.core import codegen, types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
    UserProvidedCacheLocator,
)
from numba.core.cgutils import create_struct_proxy
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import CompilerPass, PassManager, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.typed_passes import NativeLowering, NopythonRewrites
from numba.core.types.misc import unliteral
from numba.core.typing.typeof import Purpose, typeof_impl
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FindLiterallyCalls,
    InlineClosureLikes,
    LiteralPropagationSubPipelinePass,
    LiteralUnroll,
    MakeFunctionToJitFunction,
    RewriteDynamicRaises,
    RewriteSemanticConstants,
    WithLifting,
)
from numba.extending import intrinsic

from tlf_env.common.digest import code_digest
from tlf_env.common.errors import shown

try:
    import fcntl
except ImportError:  # not a system of the Unix kind
    fcntl = None  # type: ignore[assignment]

F = TypeVar("F", bound=Callable[..., Any])

PACKAGE = Path(__file__).resolve().parent.parent
DIGEST_BYTES = hashlib.sha256().digest_size
FEW = (100_000, 50, 1000)  # thresholds of Python's garbage collector while a driver is compiled
LEVEL = (
    2  # of LLVM's passes over a driver: those of level 3 take longer, and drivers are not faster
)
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
def simulation_digest() -> str:
    """Digest of all code that can hold a law, without comments and docstrings, and of Numba's version.

    Interrupted work is resumed only with the same simulation digest.
    """
    return code_digest((PACKAGE / room for room in ROOMS_WITH_LAWS), numba.__version__)


@functools.cache
def cache_folder() -> Path | None:
    """Folder of the compiled drivers; ``TLF_ENV_CACHE`` names another parent.

    It may be one that can only be read, if something was compiled into it before. Otherwise, where the
    user's cache cannot be written, it is a private folder below the system's temporary one, so that a
    driver is compiled once per machine and not once per process. None if that cannot be written either.
    A named folder that is not used gives a warning, once in a process.
    """
    found, refused = _usable(_named_folder, 0o755)
    if found is not None:
        return found
    found, _ = _usable(_temporary_folder, 0o700)
    named = os.environ.get("TLF_ENV_CACHE")
    if named:
        instead = f"compiled code is kept in {found}" if found else "no compiled code is kept"
        warnings.warn(
            f"the folder {shown(named)} of the variable TLF_ENV_CACHE is not used: {refused}; {instead}",
            RuntimeWarning,
            stacklevel=2,
        )
    return found


def _usable(parent: Callable[[], Path], mode: int) -> tuple[Path | None, str]:
    """The folder of these sources in a parent, made if it is missing; or None and why it cannot be used."""
    try:
        folder = parent() / sources_digest()
        if not folder.is_dir():
            folder.mkdir(mode, parents=True, exist_ok=True)
        if not _only_mine(folder):
            return None, "another user owns it or may write in it"
        if not _writable(folder) and not any(folder.rglob("*.nbi")):
            return None, "it cannot be written, and nothing compiled is in it"
    except OSError as error:
        return None, error.strerror or str(error)
    return folder, ""


def _named_folder() -> Path:
    named = os.environ.get("TLF_ENV_CACHE")
    try:
        folder = Path(named).expanduser() if named else Path(platformdirs.user_cache_dir("tlf_env"))
    except RuntimeError as error:
        raise FileNotFoundError("the user has no home folder") from error
    if str(folder).startswith("~"):  # a user without a home
        raise FileNotFoundError(folder)
    return folder


def _temporary_folder() -> Path:
    """A folder of this user alone below the system's temporary one: a cache holds code."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"tlf_env-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if _only_mine(folder):
        return folder
    return Path(tempfile.mkdtemp(prefix="tlf_env-"))


def _only_mine(folder: Path) -> bool:
    """Whether only this user, or root, may write in a folder: what lies in it is run."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat(follow_symlinks=False)
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid in (os.getuid(), 0)
        and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    )


def _writable(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@functools.cache
def _warn_that_nothing_is_kept(folder: Path | None) -> None:
    """Once in a process."""
    where = f"in {folder}" if folder else "in the user's cache or a temporary folder"
    warnings.warn(
        f"compiled code could not be kept {where}, so that every new process compiles it again, in "
        "a few minutes; the variable TLF_ENV_CACHE names another folder",
        RuntimeWarning,
        stacklevel=2,
    )


class _NothingKept(NullCache):
    """For a machine without a folder that can be written."""

    def save_overload(self, sig: Any, data: Any) -> None:
        _warn_that_nothing_is_kept(None)


class _Locator(UserProvidedCacheLocator):
    """Where Numba keeps a driver: in :func:`cache_folder`, which need not be writable."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(cache_folder() / self.get_suitable_cache_subpath(file))

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator | None:
        return cls(function, file) if Path(file).exists() else None

    def ensure_cache_path(self) -> None:
        Path(self._cache_path).mkdir(mode=0o755, parents=True, exist_ok=True)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (_Locator, *CompileResultCacheImpl._locator_classes)  # the others: notebooks


class _Files(IndexDataCacheFile):
    """Numba's files, objects behind a digest of their content and with the key that they belong to.

    A file may have been cut short on a full disk; and of two processes that add to an index at once, one
    overwrites the other's line, so that an object may belong to another key.
    """

    def save(self, key: Any, data: Any) -> None:
        super().save(key, (key, data))

    def load(self, key: Any) -> Any:
        saved = super().load(key)
        return saved[1] if saved is not None and saved[0] == key else None

    def _load_index(self) -> dict[Any, str]:
        try:
            index = super()._load_index()
        except Exception:  # anything may happen when a broken file is read
            return {}
        return index if isinstance(index, dict) else {}

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        digest, packed = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
        if hashlib.sha256(packed).digest() != digest:
            raise OSError(f"{name} is broken")  # Numba compiles what it cannot read
        return pickle.loads(packed)

    def _save_data(self, name: str, data: Any) -> None:
        packed = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(hashlib.sha256(packed).digest() + packed)


class _Cache(FunctionCache):
    """Numba's cache of a driver. It only saves time: what cannot be read is compiled, and kept if possible.

    Of several processes that find nothing at once, one compiles, and the others wait and read what it keeps.
    """

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._locked: BufferedWriter | None = None
        locator = self._impl.locator
        self._cache_file = _Files(
            self._cache_path, self._impl.filename_base, locator.get_source_stamp()
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = self._load(sig, target_context)
        if found is None and self._lock():
            found = self._load(sig, target_context)
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # as above
            return None

    def _lock(self) -> bool:
        """Wait until no other process compiles this driver; whether that can be known.

        The system takes the lock back when this process ends, whatever the reason.
        """
        if fcntl is None or self._locked is not None:
            return False
        path = Path(self._cache_path) / f"{self._impl.filename_base}.lock"
        try:
            self._impl.locator.ensure_cache_path()
            self._locked = path.open("wb")
            fcntl.flock(self._locked, fcntl.LOCK_EX)
        except OSError:  # a folder that cannot be written, or a file system without locks
            self.unlock()
            return False
        return True

    def unlock(self) -> None:
        """Let other processes go on."""
        if self._locked is not None:
            self._locked.close()
            self._locked = None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError:
            _warn_that_nothing_is_kept(cache_folder())


class _LinkedLibrary(JITCodeLibrary):
    """Code of a function that is only linked into its callers.

    Numba links into every function all that it calls, optimises it, and makes machine code of it, also where
    nothing but compiled code calls it. Here this is done once, for the driver: see :class:`_DriverLibrary`.
    """

    _shared_module: Any

    def finalize(self) -> None:
        """Nothing more is added; nothing is linked."""
        self._raise_if_finalized()
        for function in self._final_module.functions:
            if not function.is_declaration:
                function.linkage = "linkonce_odr"
        self._finalize_dynamic_globals()
        self._finalized = True

    def alone(self) -> Any:
        """The module of this function without those that it calls."""
        self._ensure_finalized()
        return self._final_module

    def _get_module_for_linking(self) -> Any:
        """With all that it calls, for a function that Numba compiles in its own way."""
        if self._shared_module is None:
            module = self.alone().clone()
            for library in _all_called(self._linking_libraries):
                module.link_in(_module_of(library), preserve=True)
            self._shared_module = module
        return self._shared_module


class _DriverLibrary(JITCodeLibrary):
    """Code of a driver: all that it calls, directly or not, is linked into it once."""

    def finalize(self) -> None:
        """Link, optimise, and make machine code."""
        self._raise_if_finalized()
        for library in _all_called(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(_module_of(library), preserve=True)
        self._linking_libraries.clear()
        super().finalize()


class _WideCodegen(JITCPUCodegen):
    """Numba's way to machine code for this processor, with vectors as wide as its registers.

    For Intel's processors LLVM takes half of a register of 512 bits, as the first that had them lowered their
    clock where whole ones were used. Those that came later (they know ``avx512vbmi2``) hardly do.
    """

    _library_class = _DriverLibrary

    def _customize_tm_features(self) -> str:
        features = str(super()._customize_tm_features())
        if "+avx512vbmi2" in features and "prefer-256-bit" not in features:
            features += ",-prefer-256-bit"
        return features


@functools.cache
def _wide_codegen() -> _WideCodegen:
    """The one for all drivers of this process."""
    return _WideCodegen("tlf_env")


def _all_called(libraries: list[Any]) -> list[Any]:
    """Libraries, and those that they call, each once."""
    found: dict[Any, None] = {}  # an ordered set
    left = list(reversed(libraries))
    while left:
        library = left.pop()
        if library not in found:
            found[library] = None
            if isinstance(library, _LinkedLibrary):
                left += reversed(library._linking_libraries)
    return list(found)


def _module_of(library: Any) -> Any:
    if isinstance(library, _LinkedLibrary):
        return library.alone()
    return library._get_module_for_linking()


@register_pass(mutates_CFG=True, analysis_only=False)
class _DriverLowering(NativeLowering):
    _name = "driver_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _DriverLibrary(_wide_codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return bool(super().run_pass(state))


@register_pass(mutates_CFG=True, analysis_only=False)
class _LinkedLowering(NativeLowering):
    _name = "linked_lowering"

    def run_pass(self, state: Any) -> bool:
        state.library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        key = object()  # Numba knows a function by what Python would call; here there is nothing
        state.targetctx.insert_user_function(key, state.cr.fndesc, [state.library])
        state["cr"] = state.cr._replace(cfunc=key)
        return True


# Passes over what no law has: closures, contexts, raised errors, loops over tuples, arithmetic of arrays, and
# arguments that are left out, for which there would be branches.
NOT_IN_LAWS = (
    DeadBranchPrune,
    FindLiterallyCalls,
    InlineClosureLikes,
    LiteralPropagationSubPipelinePass,
    LiteralUnroll,
    MakeFunctionToJitFunction,
    NopythonRewrites,
    RewriteDynamicRaises,
    RewriteSemanticConstants,
    WithLifting,
)


class _LinkedCompiler(CompilerBase):
    lowering: type[NativeLowering] = _LinkedLowering
    without: tuple[type[CompilerPass], ...] = NOT_IN_LAWS

    def define_pipelines(self) -> list[PassManager]:
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.passes = [
            (self.lowering if one is NativeLowering else one, what)
            for one, what in manager.passes
            if one not in self.without
        ]
        manager.finalize()
        return [manager]


class _DriverCompiler(_LinkedCompiler):
    lowering = _DriverLowering
    without = ()


@contextmanager
def _quickly() -> Iterator[None]:
    """Look less often for garbage: Numba holds millions of objects, and next to none is garbage.

    And leave out the passes of LLVM that gain nothing here, and remember what operators return.
    """
    config: Any = numba.config
    functions: Any = types.Function
    builders: Any = codegen
    with global_compiler_lock:  # so that no other thread restores what is set here
        threshold, level, ask = gc.get_threshold(), config.OPT, functions.get_call_type
        builder = builders.create_pass_builder
        gc.set_threshold(*FEW)
        builders.create_pass_builder = _create_pass_builder
        config.OPT = type(level)(min(level, LEVEL))
        functions.get_call_type = _remembering(ask)
        try:
            yield
        finally:
            functions.get_call_type = ask
            builders.create_pass_builder = builder
            config.OPT = level
            gc.set_threshold(*threshold)


def _create_pass_builder(
    machine: Any, opt: int = 2, loop_vectorize: bool = False, slp_vectorize: bool = False
) -> Any:
    """Numba's function of this name, without unrolling.

    LLVM unrolls short loops before it looks for vectors: a loop over eight robots would become its code eight
    times, for one number each.
    """
    options = llvm.create_pipeline_tuning_options()
    options.speed_level = opt
    options.slp_vectorization = slp_vectorize
    options.loop_vectorization = loop_vectorize
    options.loop_unrolling = False
    return llvm.create_pass_builder(machine, options)


def _remembering(ask: Callable[..., Any]) -> Callable[..., Any]:
    """Numba's ``get_call_type`` of operators and functions of the library, asked once for the same types.

    For each operator of each law Numba tries a dozen possibilities, and writes down why each does not fit.
    """
    known: dict[Any, Any] = {}

    def get_call_type(function: types.Function, context: Any, args: Any, kws: Any) -> Any:
        call = (function, tuple(args), tuple(kws.items()))
        if call not in known:
            known[call] = ask(function, context, args, kws)
        return known[call]

    return get_call_type


class _Driver(CPUDispatcher):
    def compile(self, sig: Any) -> Any:
        with _quickly():
            try:
                return super().compile(sig)
            finally:
                if isinstance(self._cache, _Cache):
                    self._cache.unlock()


class _Constants:
    """Of which precision the constants are in what is being compiled; see :func:`by_number`."""

    single = False

    @contextmanager
    def precision(self, single: bool) -> Iterator[None]:
        """In single precision, or in double."""
        before, self.single = self.single, single
        try:
            yield
        finally:
            self.single = before


_constants = _Constants()


@typeof_impl.register(float)
def _type_of_float(value: float, context: Any) -> Any:
    """As Numba has it, unless it is a constant of code in single precision."""
    single = _constants.single and context.purpose is Purpose.constant
    return types.float32 if single else types.float64


class _Inner(CPUDispatcher):
    """A function for compiled code. For Python it is compiled a second time, when Python first calls it.

    What Python needs to call a function takes long to compile, most of all for tuples of arrays. In single
    precision it is a third function, with other constants.
    """

    def is_single(self, args: Any) -> bool:
        """Whether a call with arguments of these types has constants in single precision: as its caller."""
        return _constants.single

    def _of(self, single: bool) -> _Inner:
        """The function with constants of this precision."""
        if not single:
            return self
        if not hasattr(self, "_single"):
            self._single = type(self)(
                self.py_func, targetoptions=self.targetoptions, pipeline_class=_LinkedCompiler
            )
        return self._single

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What a call has: a constant argument is one of its type, not a function of its own."""
        plain = {name: unliteral(one) for name, one in kws.items()}
        given, single = tuple(unliteral(one) for one in args), self.is_single(args)
        with _constants.precision(single):
            return CPUDispatcher.get_call_template(self._of(single), given, plain)

    def compile(self, sig: Any) -> Any:
        """As Numba does, without the clocks that it runs for each function and stops at every call of LLVM."""
        args, return_type = normalize_signature(sig)
        found = self.overloads.get(tuple(args))
        if found is None:
            with global_compiler_lock, self._compiling_counter:
                found = self._compiler.compile(args, return_type)
                self.add_overload(found)
        return found.entry_point

    def get_overload(self, sig: Any) -> Any:
        """What a call with these types is linked to."""
        return CPUDispatcher.get_overload(self._of(self.is_single(sig)), sig)

    def _insert(self, *_: Any) -> None:
        """Keep what was compiled from Python, which could not call it."""

    def _compile_for_args(self, *_: Any, **__: Any) -> Any:
        """What Python calls instead."""
        if not hasattr(self, "_for_python"):
            options = {**self.targetoptions, "no_cpython_wrapper": False}
            self._for_python = CPUDispatcher(self.py_func, targetoptions=options)
        return self._for_python


class _Double(_Inner):
    def is_single(self, args: Any) -> bool:
        """Never."""
        return False


class _ByNumber(_Inner):
    def is_single(self, args: Any) -> bool:
        """Whether the first argument is a number, or an array of numbers, of single precision."""
        return bool(getattr(args[0], "dtype", args[0]) == types.float32)


def _inner(function: F, of: type[_Inner] = _Inner, **options: bool) -> F:
    """Compile a function that compiled code calls."""
    if numba.config.DISABLE_JIT:
        return function
    common = {"nopython": True, "nogil": True, "error_model": "numpy"}
    without = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    dispatcher: F = of(
        function,
        targetoptions={**common, **without, **options},
        pipeline_class=_LinkedCompiler,
    )
    return dispatcher


def law(function: F) -> F:
    """Compile a scalar law so that it is inlined into its callers.

    Division by zero gives infinity as in NumPy (no branch per division), and no fast-math: two
    drivers that inline the same law must agree to the last bit.

    Laws and blocks do not count references to their array arguments: the caller holds the arrays, and a
    count is an atomic write that threads would wait for. So they make no arrays, only views.
    """
    return _inner(function, forceinline=True, _nrt=False)


def law_in_double(function: F) -> F:
    """A law whose constants are of double precision, also where it is called from code in single precision.

    Its arguments are what the caller gives; see :func:`tlf_env.numerics.memory.like`.
    """
    return _inner(function, _Double, forceinline=True, _nrt=False)


def by_number(function: F) -> F:
    """A block in the precision of its first argument: a number, or an array of numbers.

    In single precision all float constants of what it calls are single, too: otherwise every sum with a
    constant would be computed in double precision.
    """
    return _inner(function, _ByNumber, forceinline=False)


def block(function: F) -> F:
    """Compile a larger law that is called rather than inlined, to keep compile times short.

    Numba would inline it all the same where a law calls it, as what it compiles for a function takes over
    that function's options, unless they are set.
    """
    return _inner(function, forceinline=False, _nrt=False)


def view(function: F) -> F:
    """Compile a function that returns a view of an array, into its callers' own source."""
    compiled: F = numba.njit(error_model="numpy", nogil=True, inline="always")(function)
    return compiled


def allocating(function: F) -> F:
    """Compile a block that makes an array and works on it by laws, which see its shape."""
    return _inner(function, forceinline=False)


def driver(function: F) -> F:
    """Compile a function over arrays, and keep the result on disk."""
    if numba.config.DISABLE_JIT:
        return function
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    dispatcher: Any = _Driver(function, targetoptions=options, pipeline_class=_DriverCompiler)
    dispatcher._cache = _NothingKept() if cache_folder() is None else _Cache(function)
    compiled: F = dispatcher
    return compiled


def compile_for(function: Callable[..., Any], *arguments: Any) -> bool:
    """Compile a driver for the types of some arguments, or load it from the cache; it is not called.

    Returns whether it was not in the cache.
    """
    dispatcher: Any = function
    if not hasattr(dispatcher, "typeof_pyval"):  # Numba is switched off
        return False
    before = sum(dispatcher.stats.cache_misses.values())
    dispatcher.compile(tuple(dispatcher.typeof_pyval(one) for one in arguments))
    return bool(sum(dispatcher.stats.cache_misses.values()) > before)


@intrinsic
def fetch_add(typing: Any, numbers: Any, amount: Any) -> Any:
    """Add to an array's first whole number and return its old value, atomically."""

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        array = create_struct_proxy(signature.args[0])(context, builder, value=values[0])
        return builder.atomic_rmw("add", array.data, values[1], "monotonic")

    return types.int64(numbers, types.int64), build
