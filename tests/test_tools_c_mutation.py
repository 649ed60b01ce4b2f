"""tools/c_mutation.py: the mutants that it makes of C, and how it tells them from the model."""

from fnmatch import fnmatch
from pathlib import Path

import pytest
from build_core import FOLDERS
from c_mutants import mutants
from c_mutation import TESTS


@pytest.mark.parametrize(
    ("code", "texts"),
    [
        ("x = a < b;", {"<=", ">=", ""}),
        ("return a == b;", {"!=", ""}),
        ("if (a && b) { return; }", {"||", "0", "1", ""}),
        ("while (a) { }", {"0"}),
        ("if (!a) { f(a); }", {"", "0", "1"}),
        ("x = a - -b;", {"+", ""}),
        ("x += *p & 7U;", {"-=", "|", "8U", "6U", ""}),
        ("x = 0x1p-3 + 2.0 * 0;", {"-", "/", "(0x1p-3 * 10.0)", "(0x1p-3 / 10.0)", "(2.0 * 10.0)",
                                    "(2.0 / 10.0)", "1", ""}),
        ("for (int i = 1; i < n; ++i) { }", {"<=", ">=", "2", "0", "--"}),
        ('const char *s = "a < 1"; // b < 2', {"/"}),
        ("double a[4], b[4][3];", set()),
        ("x = a[4];", {"", "5", "3"}),
        ("assert(a < 3);", set()),
    ],
)  # fmt: skip
def test_mutants_of_one_place(code: str, texts: set[str]) -> None:
    """Comments, texts and declarations are left alone."""
    source = f"#define MOST 3\nstatic int f(void)\n{{\n    {code}\n}}\n"
    found = mutants(source)
    assert {mutant.mutated for mutant in found} == texts
    assert all(mutant.line == 4 and mutant.function == "f" for mutant in found)
    for mutant in found:
        assert mutant.apply(source) != source


def test_values_of_constants_are_changed() -> None:
    """They stand outside of functions."""
    found = mutants("static const double STEPS[2] = {1.5, 0.0};\nint f(int a);\n")
    assert [mutant.mutated for mutant in found] == ["(1.5 * 10.0)", "(1.5 / 10.0)", "1.0"]


def test_each_file_has_tests_that_are_there() -> None:
    """What survives the streams meets them."""
    root = Path(__file__).parents[1]
    for source in [path for folder in FOLDERS for path in folder.glob("*.c")]:
        place = source.relative_to(root).as_posix()
        tests = next(tests for pattern, tests in TESTS.items() if fnmatch(place, pattern))
        assert tests
        assert [name for name in tests if not (root / name).exists()] == []
