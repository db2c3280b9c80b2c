"""Compiled code is kept where possible. Whatever happens to the files, the functions run and are right."""

from __future__ import annotations

import copy
import errno
import fcntl
import functools
import gc
import importlib.util
import os
import pickle
import shutil
import stat
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numba
import numpy as np
import pytest

from tlf_env.numerics import compiled

SOURCE = """
from tlf_env.numerics.compiled import driver

@driver
def double(a):
    for i in range(a.size):
        a[i] *= 2.0
"""
KINDS = ("*.nbi", "*.nbc")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of compiled drivers."""
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o755)
    monkeypatch.setattr(compiled, "cache_folder", lambda: folder)
    compiled._warn_that_nothing_is_kept.cache_clear()
    return folder


@pytest.fixture
def hits(tmp_path: Path) -> Callable[..., int]:
    """Runs a driver as a new process would; how often its code was found in the cache."""
    path = tmp_path / "probe.py"
    path.write_text(SOURCE)

    def run(dtype: Any = np.float64) -> int:
        spec = importlib.util.spec_from_file_location("probe", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        a = np.ones(3, dtype=dtype)
        module.double(a)
        assert a.tolist() == [2.0, 2.0, 2.0]
        return sum(module.double.stats.cache_hits.values())

    return run


def one(folder: Path, kind: str) -> Path:
    (path,) = folder.rglob(kind)
    return path


def test_what_was_compiled_once_is_found_again(cache, hits):
    assert [hits(), hits(), hits(np.float32), hits(np.float32), hits()] == [0, 1, 0, 1, 1]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("part", [0.0, 0.001, 0.1, 0.5, 0.9, 0.999])
def test_a_file_cut_short_is_compiled_and_written_anew(cache, hits, kind, part):
    hits()
    path = one(cache, kind)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    assert [hits(), hits()] == [0, 1]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "content", [b"\0" * 5000, b"garbage", os.urandom(4000), b"I1\n.", b"\x80\x04]\x94.", b"N."]
)
def test_garbage_is_compiled_and_written_anew(cache, hits, kind, content):
    hits()
    one(cache, kind).write_bytes(content)
    assert [hits(), hits()] == [0, 1]


@pytest.mark.parametrize("place", [0, 31, 32, 200, -1])
def test_a_single_wrong_bit_is_seen(cache, hits, place):
    hits()
    path = one(cache, "*.nbc")
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    assert [hits(), hits()] == [0, 1]


def test_an_object_of_another_signature_is_not_taken(cache, hits):
    """Two processes that add to an index at once may leave it with the other's object."""
    hits()
    hits(np.float32)
    first, second = sorted(cache.rglob("*.nbc"))
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    assert [hits(), hits(np.float32), hits(), hits(np.float32)] == [0, 0, 1, 1]


def test_an_index_without_its_object_is_no_harm(cache, hits):
    hits()
    one(cache, "*.nbc").unlink()
    assert [hits(), hits()] == [0, 1]


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Every file of the cache fails to be written, with the error in the list."""
    error = [errno.ENOSPC]
    real = compiled._Files._open_for_write

    def fail(self: Any, path: str) -> Any:
        raise OSError(error[0], os.strerror(error[0]), path)

    monkeypatch.setattr(compiled._Files, "_open_for_write", fail)
    yield error
    monkeypatch.setattr(compiled._Files, "_open_for_write", real)


@pytest.mark.parametrize(
    "error", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO]
)
def test_a_disk_that_takes_nothing_warns_once(cache, hits, full_disk, error):
    full_disk[0] = error
    with pytest.warns(RuntimeWarning, match="could not be kept") as seen:
        assert [hits(), hits(np.float32)] == [0, 0]
    assert len(seen) == 1
    message = str(seen[0].message)
    assert str(cache) in message
    assert "TLF_ENV_CACHE" in message
    assert "\n" not in message


def test_a_disk_that_fills_up_between_index_and_object_is_no_harm(cache, hits, monkeypatch):
    def fail(self: Any, name: str, data: Any) -> None:
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(compiled._Files, "_save_data", fail)
        with pytest.warns(RuntimeWarning, match="could not be kept"):
            assert hits() == 0
    assert [hits(), hits()] == [0, 1]


def test_files_beyond_the_limit_of_the_process_leave_nothing_behind(cache, hits):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.warns(RuntimeWarning, match="could not be kept"):
            assert hits() == 0
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(cache.rglob("*.tmp.*"))
    assert [hits(), hits()] == [0, 1]


def test_no_folder_at_all_warns_once(tmp_path, monkeypatch, hits):
    monkeypatch.setattr(compiled, "cache_folder", lambda: None)
    compiled._warn_that_nothing_is_kept.cache_clear()
    with pytest.warns(RuntimeWarning, match=r"could not be kept.*TLF_ENV_CACHE") as seen:
        assert [hits(), hits()] == [0, 0]
    assert len(seen) == 1


# --- which folder ------------------------------------------------------------------------------------


def no_temporary_folder() -> str:
    raise FileNotFoundError("No usable temporary directory found")


def chosen() -> Path | None:
    return compiled.cache_folder.__wrapped__()


def test_without_a_temporary_folder_the_named_one_is_used(tmp_path, monkeypatch):
    monkeypatch.setenv("TLF_ENV_CACHE", str(tmp_path))
    monkeypatch.setattr(compiled.tempfile, "gettempdir", no_temporary_folder)
    assert chosen() == tmp_path / compiled.sources_digest()


def test_without_any_folder_there_is_none(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TLF_ENV_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(compiled.tempfile, "gettempdir", no_temporary_folder)
    with pytest.warns(RuntimeWarning, match="no compiled code is kept"):
        assert chosen() is None


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The system's temporary folder."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(tmp_path / "tmp"))
    return tmp_path / "tmp"


def test_a_tilde_of_the_named_folder_is_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.setenv("TLF_ENV_CACHE", "~/cc")
    assert chosen() == tmp_path / "cc" / compiled.sources_digest()


def test_a_tilde_of_an_unknown_user_warns(tmp_path, monkeypatch, temporary):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TLF_ENV_CACHE", "~no-such-user-here/cc")
    with pytest.warns(RuntimeWarning, match="not used: the user has no home folder"):
        assert chosen().is_relative_to(temporary)


def test_a_named_folder_that_is_not_used_warns_once(tmp_path, monkeypatch, temporary):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TLF_ENV_CACHE", str(tmp_path / "file"))
    anew = functools.cache(compiled.cache_folder.__wrapped__)
    with pytest.warns(RuntimeWarning, match="TLF_ENV_CACHE is not used") as seen:
        assert anew() == anew()
    assert len(seen) == 1
    message = str(seen[0].message)
    assert "Not a directory" in message or "exists" in message
    assert str(anew()) in message
    assert anew().is_relative_to(temporary)
    assert "\n" not in message


def test_a_usual_folder_that_is_not_used_gives_no_warning(tmp_path, monkeypatch, temporary):
    (tmp_path / "file").touch()
    monkeypatch.delenv("TLF_ENV_CACHE", raising=False)
    monkeypatch.setattr(compiled.platformdirs, "user_cache_dir", lambda name: tmp_path / "file")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert chosen().is_relative_to(temporary)


def test_a_user_without_a_home_gets_no_folder_named_tilde(tmp_path, monkeypatch):
    monkeypatch.delenv("TLF_ENV_CACHE", raising=False)
    monkeypatch.setattr(compiled.platformdirs, "user_cache_dir", lambda name: f"~/.cache/{name}")
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert chosen().is_relative_to(tmp_path)
    assert not (tmp_path / "~").exists()


@pytest.fixture
def warm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with something compiled, that cannot be written; the temporary folder can."""
    folder = tmp_path / "warm" / compiled.sources_digest()
    folder.mkdir(mode=0o755, parents=True)
    (folder / "probe.nbi").touch()
    (tmp_path / "tmp").mkdir()
    real = compiled._writable
    monkeypatch.setattr(
        compiled, "_writable", lambda one: not one.is_relative_to(folder) and real(one)
    )
    monkeypatch.setenv("TLF_ENV_CACHE", str(folder.parent))
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(tmp_path / "tmp"))
    return folder


def test_a_warm_folder_that_cannot_be_written_is_used(warm):
    assert chosen() == warm


def test_an_empty_folder_that_cannot_be_written_is_not(warm, tmp_path):
    (warm / "probe.nbi").unlink()
    with pytest.warns(RuntimeWarning, match="cannot be written, and nothing compiled is in it"):
        assert chosen().is_relative_to(tmp_path / "tmp")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners and modes on Windows")
@pytest.mark.parametrize("mode", [0o775, 0o757, 0o777])
def test_code_is_not_loaded_from_a_folder_that_others_may_write(warm, tmp_path, mode):
    warm.chmod(mode)
    with pytest.warns(RuntimeWarning, match="another user owns it or may write in it"):
        assert chosen().is_relative_to(tmp_path / "tmp")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owners and modes on Windows")
@pytest.mark.parametrize(("owner", "taken"), [("mine", True), ("root", True), ("other", False)])
def test_code_is_loaded_from_a_folder_of_the_user_or_root_only(warm, monkeypatch, owner, taken):
    me = warm.stat().st_uid
    real = Path.stat

    def owned(path: Path, **options: Any) -> os.stat_result:
        values = list(real(path, **options))
        if path == warm:
            values[stat.ST_UID] = {"mine": me + 7, "root": 0, "other": me + 8}[owner]
        return os.stat_result(values)

    monkeypatch.setattr(Path, "stat", owned)
    monkeypatch.setattr(compiled.os, "getuid", lambda: me + 7)
    with nullcontext() if taken else pytest.warns(RuntimeWarning, match="another user owns it"):
        assert (chosen() == warm) is taken


def environment(tmp_path: Path) -> dict[str, str]:
    path = os.pathsep.join([str(compiled.PACKAGE.parent), str(tmp_path)])
    return os.environ | {"PYTHONPATH": path, "TLF_ENV_CACHE": str(tmp_path / "cache")}


CHILD = """
import numpy as np, probe
a = np.ones(3)
probe.double(a)
assert a.tolist() == [2.0, 2.0, 2.0]
print(sum(probe.double.stats.cache_hits.values()))
"""


def test_of_processes_that_start_at_once_on_an_empty_cache_one_compiles(tmp_path):
    (tmp_path / "probe.py").write_text(SOURCE)
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", CHILD]
    crowd = [
        subprocess.Popen(command, env=environment(tmp_path), stdout=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    found = sorted(one.communicate()[0].split()[0] for one in crowd)  # in the cache, by each
    assert found == ["0", "1", "1", "1"]
    assert all(one.returncode == 0 for one in crowd)
    last = subprocess.run(
        command, env=environment(tmp_path), capture_output=True, text=True, check=True
    )
    assert last.stdout.split() == ["1"]


def test_a_process_waits_for_another_that_compiles_even_if_that_one_is_killed(
    cache, hits, tmp_path
):
    hits()
    lock = one(cache, "*.lock")
    code = f"import fcntl, time; f = open({str(lock)!r}, 'wb'); fcntl.flock(f, fcntl.LOCK_EX); "
    other = subprocess.Popen(
        [sys.executable, "-c", code + "print('has it', flush=True); time.sleep(600)"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout.readline() == "has it\n"
    assert hits() == 1  # what is in the cache needs no lock
    waiting = threading.Thread(target=hits, args=(np.float32,))
    waiting.start()
    waiting.join(1.0)
    assert waiting.is_alive()
    other.kill()
    other.communicate()
    waiting.join()
    assert hits(np.float32) == 1


def test_a_driver_that_cannot_be_compiled_lets_others_go_on(cache):
    @compiled.driver
    def wrong(a: Any) -> Any:
        return a.no_such_attribute

    for _ in range(2):
        with pytest.raises(numba.TypingError):
            wrong(1.0)
    with one(cache, "*.lock").open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # else BlockingIOError


def test_a_read_only_folder_is_read_by_a_process_that_cannot_write_it(tmp_path):
    """Root may write everywhere, unless it gives that up."""
    drop: list[str] = []
    if os.getuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root, without setpriv")
        drop = [
            "setpriv",
            "--bounding-set=-dac_override,-dac_read_search,-fowner",
            "--inh-caps=-all",
        ]
        if subprocess.run([*drop, "true"], check=False, capture_output=True).returncode != 0:
            pytest.skip("setpriv is not allowed here")
    (tmp_path / "probe.py").write_text(SOURCE)
    command = [*drop, sys.executable, "-c", CHILD]
    for expected in ("0", "1"):
        done = subprocess.run(
            command, env=environment(tmp_path), capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == [expected], done.stderr
        paths = [tmp_path / "cache", *(tmp_path / "cache").rglob("*")]
        for path in paths:
            path.chmod(path.stat().st_mode & ~0o222)
    for path in paths:
        path.chmod(0o755)


# --- functions for compiled code -----------------------------------------------------------------------


class Pair(NamedTuple):
    first: float
    second: float


@compiled.law
def swapped(pair: Pair, by: float) -> Pair:
    return Pair(pair.second / by, pair.first)


@compiled.block
def doubled(a: np.ndarray) -> None:
    for i in range(a.shape[0]):
        a[i] *= 2.0


def test_python_can_call_what_is_compiled_for_compiled_code(cache):
    """Before compiled code has called it and after, as a copy, and for other types."""

    def both(a: np.ndarray) -> float:
        doubled(a)
        return swapped(Pair(1.0, a[0]), 0.0).first

    for dtype in (np.float64, np.float32):
        for _ in range(2):
            assert swapped(Pair(1.0, 3.0), by=2.0) == (1.5, 1.0)
            assert swapped(Pair(1.0, 3.0), dtype(0.0)) == (np.inf, 1.0)
            a = np.ones(2, dtype=dtype)
            doubled(a)
            assert a.tolist() == [2.0, 2.0]
            assert compiled.driver(both)(a) == np.inf
            assert a.tolist() == [4.0, 4.0]
    for other in (copy.deepcopy(swapped), pickle.loads(pickle.dumps(swapped))):
        assert other(Pair(1.0, 3.0), 2.0) == (1.5, 1.0)
    with pytest.raises(numba.TypingError):
        swapped("text", 1.0)


@compiled.law
def twice_swapped(pair: Pair) -> Pair:
    return swapped(swapped(pair, 2.0), 4.0)


def test_compiled_code_of_others_calls_laws_that_call_laws(cache):
    """What a law calls is linked into a driver once; Numba's own compilation gets it with the law."""

    def called(a: np.ndarray) -> float:
        doubled(a)
        return twice_swapped(Pair(a[0], 3.0)).first + swapped(Pair(5.0, 3.0), 1.0).second

    expected = 2.0 / 4.0 + 5.0
    for compiling in (numba.njit, compiled.driver, numba.njit):
        assert compiling(called)(np.ones(2)) == expected
    assert twice_swapped(Pair(2.0, 3.0)) == (2.0 / 4.0, 3.0 / 2.0)


def test_compiling_leaves_numba_as_it_was(cache):
    asks, level = numba.types.Function.get_call_type, numba.config.OPT

    def wrong(a: float) -> float:
        return a + "text"

    with pytest.raises(numba.TypingError):
        compiled.driver(wrong)(1.0)
    assert compiled.driver(abs_of)(-1.0) == 1.0
    assert numba.types.Function.get_call_type is asks
    assert numba.config.OPT is level


def test_vectors_are_as_wide_as_the_registers(cache):
    """LLVM takes half of a register of 512 bits for Intel's processors; the first that had them are left so."""
    if "+avx512vbmi2" not in str(llvm.get_host_cpu_features().flatten()):
        pytest.skip("a processor without such registers, or one of the first that had them")

    @compiled.driver
    def double(a: np.ndarray) -> None:
        for i in range(a.size):
            a[i] *= 2.0

    numbers = np.arange(100.0)
    double(numbers)
    np.testing.assert_array_equal(numbers, 2.0 * np.arange(100.0))
    (code,) = double.inspect_asm().values()
    assert "zmm" in code


def test_a_driver_is_compiled_without_being_called(cache):
    def driven(a: np.ndarray) -> None:
        doubled(a)

    a = np.ones(2)
    driver = compiled.driver(driven)
    assert compiled.compile_for(driver, a)
    assert not compiled.compile_for(driver, a)
    assert not compiled.compile_for(compiled.driver(driven), a)
    assert a.tolist() == [1.0, 1.0]
    assert not compiled.compile_for(driven, a)


def test_nothing_is_cached_where_numba_is_switched_off(monkeypatch):
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compiled.driver(abs_of)(-2.0) == 2.0
        assert compiled.law(abs_of) is abs_of


def abs_of(value: float) -> float:
    return abs(value)


def test_compiling_leaves_the_garbage_collector_as_it_was(cache, hits):
    before = gc.get_threshold()
    gc.set_threshold(123, 4, 5)
    try:
        assert hits() == 0
        assert gc.get_threshold() == (123, 4, 5)
    finally:
        gc.set_threshold(*before)
