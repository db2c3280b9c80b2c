"""Digests of code: what changes a law changes them, and rewording does not."""

import pytest

from tlf_env.common.digest import code_digest, code_of

SOURCE = '''"""A module."""

from math import sin


class Law:
    """Something."""

    gain: float = 2.0  # a gain


def law(x: float, y: float = 1.0) -> float:
    """Twice the sine."""
    # as in the paper
    if x is None:
        return None
    return 2.0 * sin(x) + y
'''
SAME = [
    SOURCE.replace("# as in the paper", "# as everywhere"),
    SOURCE.replace('"""Twice the sine."""\n', '"""The sine, twice.\n\n    More.\n    """\n'),
    SOURCE.replace('    """Twice the sine."""\n', ""),
    SOURCE.replace('"""A module."""\n', ""),
    SOURCE.replace("2.0 * sin(x) + y", "(\n        2.0 * sin(x)\n        + y\n    )"),
    SOURCE.replace("2.0 * sin(x)", "(2.0 * sin(x))"),
]
OTHER = [
    SOURCE.replace("2.0 * sin(x) + y", "y + 2.0 * sin(x)"),
    SOURCE.replace("2.0 * sin(x)", "2 * sin(x)"),
    SOURCE.replace("2.0 * sin(x)", "2.0000000000000004 * sin(x)"),
    SOURCE.replace("y: float = 1.0", "y: float = -1.0"),
    SOURCE.replace("return None", "return False"),
    SOURCE.replace("gain: float = 2.0", "gain: float = 2.5"),
    SOURCE.replace("import sin", "import cos as sin"),
    SOURCE.replace("x is None", "x is not None"),
    SOURCE.replace("def law(", "async def law("),
]


def digest(tmp_path, source, name="laws.py"):
    folder = tmp_path / "room"
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    (folder / name).write_text(source)
    return code_digest([folder])


@pytest.mark.parametrize("source", SAME)
def test_comments_docstrings_and_layout_do_not_count(source, tmp_path):
    assert source != SOURCE
    assert digest(tmp_path, source) == digest(tmp_path, SOURCE)


def test_every_change_of_the_code_counts(tmp_path):
    sources = [SOURCE, *OTHER]
    assert len(set(sources)) == len(sources)
    assert len({digest(tmp_path, source) for source in sources}) == len(sources)


def test_the_names_of_files_and_further_texts_count(tmp_path):
    first = digest(tmp_path, SOURCE)
    assert digest(tmp_path, SOURCE, "other.py") != first
    digest(tmp_path, SOURCE)
    assert code_digest([tmp_path / "room"], "numba 1") != first
    (tmp_path / "room" / "more.py").write_text("")
    assert code_digest([tmp_path / "room"]) != first


def test_a_string_that_is_no_docstring_counts():
    assert code_of("x = 'a'") != code_of("x = 'b'")
    assert code_of("f('a')") != code_of("f('b')")


def test_empty_fields_do_not_count_because_versions_of_python_differ_in_them():
    found = code_of("def f(): pass")
    for field in ("type_comment", "decorator_list", "returns", "type_params"):
        assert field not in found


def test_a_digest_has_twelve_digits(tmp_path):
    found = digest(tmp_path, SOURCE)
    assert len(found) == 12
    int(found, 16)
