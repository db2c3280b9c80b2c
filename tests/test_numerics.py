from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tlf_env.numerics import compiled
from tlf_env.numerics.angles import wrap
from tlf_env.numerics.compiled import driver
from tlf_env.numerics.indices import natural, slot_of
from tlf_env.numerics.philox import MAX_SEED, normal_pair, unit, words
from tlf_env.numerics.rows import entries_writer, replacing

untimed = settings(deadline=None)  # the first call compiles

DRAWS = 200_000
numbers_32 = st.integers(0, 2**32 - 1)
numbers_63 = st.integers(0, MAX_SEED)


@driver
def fill_normal(out: np.ndarray, seed: int, channel: int, robot: int, episode: int) -> None:
    for i in range(out.shape[0]):
        out[i, 0], out[i, 1] = normal_pair(seed, channel, robot, episode, i)


def normal_draws(
    seed: int = 1, channel: int = 1, robot: int = 0, episode: int = 0, count: int = DRAWS
) -> np.ndarray:
    out = np.empty((count, 2))
    fill_normal(out, seed, channel, robot, episode)
    return out


def numpy_words(seed: int, channel: int, robot: int, episode: int, index: int) -> tuple[int, ...]:
    """NumPy raises its counter by one before the first block."""
    counter = (index + (episode << 64) - 1) % 2**256
    key = seed + (((channel << 32) | robot) << 64)
    block = np.random.Philox(key=key, counter=counter).random_raw(4)
    return tuple(int(word) for word in block)


@untimed
@given(numbers_63, numbers_32, numbers_32, numbers_63, numbers_63)
def test_words_are_those_of_numpy(seed, channel, robot, episode, index):
    assert words(seed, channel, robot, episode, index) == numpy_words(
        seed, channel, robot, episode, index
    )


@pytest.mark.parametrize("seed", [0, 1, 2**32, 2**62 + 12345, MAX_SEED])
@pytest.mark.parametrize("channel", [0, 2**32 - 1])
@pytest.mark.parametrize("index", [0, 1, MAX_SEED])
def test_words_are_those_of_numpy_at_the_ends_of_the_ranges(seed, channel, index):
    args = (seed, channel, 2**32 - 1, 0, index)
    assert words(*args) == numpy_words(*args)


@pytest.mark.parametrize("word", [0, 1, 2**11 - 1, 2**11, 2**63, 2**64 - 2**11, 2**64 - 1])
def test_unit_is_the_upper_53_bits(word):
    assert unit(np.uint64(word)) == (word >> 11) / 2**53
    assert 0.0 <= unit(np.uint64(word)) < 1.0


@untimed
@given(numbers_63, numbers_32, numbers_63)
def test_normal_numbers_are_finite(seed, robot, index):
    assert np.isfinite(normal_pair(seed, 1, robot, 0, index)).all()


@pytest.mark.parametrize("seed", [0, MAX_SEED])
def test_normal_numbers_have_the_moments_of_a_normal_distribution(seed):
    z = normal_draws(seed).ravel()
    five_sigma = 5 / np.sqrt(z.size)
    assert abs(z.mean()) < five_sigma
    assert abs((z**2).mean() - 1) < five_sigma * np.sqrt(2)
    assert abs((z**3).mean()) < five_sigma * np.sqrt(15)
    assert abs((z**4).mean() - 3) < five_sigma * np.sqrt(96)


def test_normal_numbers_follow_the_normal_distribution_function():
    stats = pytest.importorskip("scipy.stats")
    for column in normal_draws().T:
        assert stats.kstest(column, "norm").pvalue > 1e-4


def test_the_two_numbers_of_a_pair_and_successive_draws_are_independent():
    z = normal_draws()
    bound = 5 / np.sqrt(DRAWS)
    a, b = z.T
    for x, y in [(a, b), (a[1:], a[:-1]), (a[1:], b[:-1])]:
        assert abs(np.mean(x * y)) < bound
        assert abs(np.mean((x**2 - 1) * (y**2 - 1))) < 2 * bound


@pytest.mark.parametrize(
    "other", [{"seed": 2}, {"channel": 2}, {"robot": 1}, {"episode": 1}], ids=str
)
def test_streams_that_differ_in_one_argument_are_independent(other):
    a, b = normal_draws().ravel(), normal_draws(**other).ravel()
    assert not np.isin(a[:1000], b[:1000]).any()
    assert abs(np.mean(a * b)) < 5 / np.sqrt(a.size)


def test_a_draw_depends_on_its_arguments_only():
    whole = normal_draws(count=100)
    order = np.random.default_rng(0).permutation(100)
    for index in order:
        assert normal_pair(1, 1, 0, 0, index) == tuple(whole[index])
        normal_pair(5, 2, 1, 3, index)


@untimed
@given(st.floats(-1e6, 1e6))
def test_wrap_keeps_the_direction_within_half_a_turn(angle):
    wrapped = wrap(angle)
    assert abs(wrapped) <= np.pi * (1 + 1e-15)
    assert np.hypot(np.sin(wrapped) - np.sin(angle), np.cos(wrapped) - np.cos(angle)) < 1e-9


def test_wrap_leaves_small_angles_alone():
    for angle in (0.0, -0.0, 1e-300, 1.0, -3.1):
        assert wrap(angle) == angle


@pytest.fixture
def copied_package(tmp_path: Path) -> Path:
    return Path(
        shutil.copytree(
            compiled.PACKAGE, tmp_path / "tlf_env", ignore=shutil.ignore_patterns("__pycache__")
        )
    )


def digest_of(package: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(compiled, "PACKAGE", package)
    return compiled.sources_digest.__wrapped__()


def test_digest_follows_every_source_that_can_hold_a_law(copied_package, monkeypatch):
    assert digest_of(copied_package, monkeypatch) == compiled.sources_digest()
    seen = {compiled.sources_digest()}
    for room in compiled.ROOMS_WITH_LAWS:
        source = sorted((copied_package / room).glob("*.py"))[-1]
        source.write_text(source.read_text() + "\n# edited\n")
        digest = digest_of(copied_package, monkeypatch)
        assert digest not in seen, source
        seen.add(digest)


def test_digest_follows_names_of_sources(copied_package, monkeypatch):
    before = digest_of(copied_package, monkeypatch)
    (copied_package / "physics" / "friction.py").rename(copied_package / "physics" / "other.py")
    assert digest_of(copied_package, monkeypatch) != before


def test_every_room_that_compiles_laws_is_in_the_digest():
    compilers = {"law", "block", "driver", "view", "allocating", "reader", "writer", "replacing"}
    modules = ("tlf_env.numerics.compiled", "tlf_env.numerics.rows")
    for path in compiled.PACKAGE.rglob("*.py"):
        imported = {
            name.name
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module in modules
            for name in node.names
        }
        if imported & compilers:
            assert path.parent.name in compiled.ROOMS_WITH_LAWS
            assert path.parent.parent == compiled.PACKAGE


def test_outside_physics_the_body_is_imported_from_one_module():
    allowed = {"vehicle", "units", "linear", "openloop", "pymunk_plant", "chipmunk_plant"}
    allowed |= {"world", "reach", "ranging", "borders", "shapes"}  # of no body
    for path in compiled.PACKAGE.rglob("*.py"):
        if path.parent.name == "physics":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "tlf_env.physics"
            ):
                assert node.module.removeprefix("tlf_env.physics.") in allowed, path


def test_cache_lies_where_the_variable_says(tmp_path, monkeypatch):
    monkeypatch.setenv("TLF_ENV_CACHE", str(tmp_path / "new"))
    folder = compiled.cache_folder.__wrapped__()
    assert folder == tmp_path / "new" / compiled.sources_digest()
    assert folder.is_dir()


def test_cache_falls_back_to_a_private_folder_when_it_cannot_be_written(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("TLF_ENV_CACHE", str(file))
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(tmp_path))
    folder = compiled.cache_folder.__wrapped__()
    assert folder.is_relative_to(tmp_path)
    assert folder.name == compiled.sources_digest()
    assert folder.stat().st_mode & 0o777 == 0o700
    (folder / "probe").touch()


ONE_DRIVER = """
import numpy as np
from tlf_env.numerics.compiled import driver
from tlf_env.numerics.indices import natural, slot_of

@driver
def double(a):
    for i in range(a.size):
        a[i] *= 2.0

a = np.ones(3)
double(a)
assert a.tolist() == [2.0, 2.0, 2.0]
print(sum(double.stats.cache_hits.values()))
"""


def test_a_read_only_package_compiles_once_and_writes_to_the_cache_only(copied_package, tmp_path):
    (copied_package / "task" / "probe.py").write_text(ONE_DRIVER)
    files = sorted(copied_package.rglob("*"))
    for path in (copied_package, *files):
        path.chmod(0o555 if path.is_dir() else 0o444)
    environment = os.environ | {
        "TLF_ENV_CACHE": str(tmp_path / "cache"),
        "PYTHONPATH": str(tmp_path),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    try:
        for hits in ("0", "1"):
            done = subprocess.run(
                [sys.executable, "-m", "tlf_env.task.probe"],
                env=environment,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, done.stderr
            assert done.stdout.split() == [hits]
        assert sorted(copied_package.rglob("*")) == files
        assert list((tmp_path / "cache").rglob("*.nbc"))
    finally:
        for path in (copied_package, *files):
            path.chmod(0o755)


class Row(NamedTuple):
    first: float
    second: float
    third: float


write_row = entries_writer(Row, 1)
with_third = replacing(Row, "third")
with_outer = replacing(Row, "third", "first")


@given(st.tuples(*(st.floats(allow_nan=False),) * 3), st.floats(allow_nan=False))
@untimed
def test_replacing_changes_the_named_fields_and_copies_the_others(values, new):
    row = Row(*values)
    assert with_third(row, new) == row._replace(third=new)
    assert with_outer(row, new, 0.0) == row._replace(third=new, first=0.0)
    assert with_outer.py_func(row, first=0.0, third=new) == row._replace(third=new, first=0.0)


def test_replacing_refuses_a_name_that_is_no_field():
    with pytest.raises(ValueError, match="Row has no field fourth"):
        replacing(Row, "first", "fourth")


@given(st.integers(0, 2**63 - 1), st.integers(1, 2**40))
@untimed
def test_a_slot_is_the_remainder(step, slots):
    assert slot_at(step, slots) == slot_of.py_func(step, slots) == step % slots
    assert natural.py_func(step) == step


@driver
def slot_at(step: int, slots: int) -> int:
    return slot_of(step, slots)


@driver
def write_two(array: np.ndarray, lane: int, robot: int, values: Any) -> None:
    write_row(array, lane, robot, values)


def test_a_row_is_written_entry_by_entry():
    array = np.zeros((2, 3, 5))
    write_two(array, 1, 2, Row(4.0, 5.0, 6.0))
    assert array[1, 2].tolist() == [0.0, 4.0, 5.0, 6.0, 0.0]
    assert array.sum() == 15.0
