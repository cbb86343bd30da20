import math
import re

import pytest

from dxlrun.compile.motion_samples import LONGEST_FORMULA, Expression


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("t", 3.0),
        ("-t ** 2", -9.0),
        ("2 * pi", 2 * math.pi),
        ("sqrt(abs(-16)) + exp(0) - tan(0)", 5.0),
        ("min(t, 1) + max(t, 5)", 6.0),
        ("7 % 4 / 2", 1.5),
        ("t" + "+t" * 90, 273.0),
    ],
)
def test_operations(text: str, value: float):
    assert Expression(text).at(3.0) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("sin(x)", "unknown name x"),
        ("sinus(t)", "unknown function sinus"),
        ("__import__('os').getcwd()", "an operator is missing"),
        ("t.real", "Attribute"),
        ("'a' * 9", "not a real number"),
        ("1j * t", "not a real number"),
        ("True", "not a real number"),
        ("[t for t in (1,)]", "ListComp"),
        ("t if t > 1 else 0", "IfExp"),
        ("1 << 9", "LShift"),
        ("2(t)", "write 2 * (t)"),
        ("t = 1", "not an expression"),
        ("sin(t", "not an expression"),
        ("", "not an expression"),
        ("sin + t", "unknown name sin"),
        ("(" * 500 + "t" + ")" * 500, "at most"),
        ("(" * 450 + "t" + ")" * 450, "not an expression"),
        ("t" + "+t" * 300, "group long sums"),
        ("t" + "+t" * LONGEST_FORMULA, "at most"),
    ],
)
def test_what_is_no_formula_is_refused_with_a_sentence(text: str, says: str):
    with pytest.raises(ValueError, match=re.escape(says)):
        Expression(text)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 / t", "division by zero"),
        ("t % 0", "division by zero"),
        ("sqrt(t - 1)", "undefined"),
        ("(t - 1) ** 0.5", "undefined"),
        ("exp(1000)", "too large"),
        ("9 ** 9 ** 9", "too large"),
        ("abs(" + "9" * 400 + ")", "too large"),
        ("1e308 * 10", "not finite"),
        ("sin(t, t)", "wrong number of arguments"),
    ],
)
def test_where_a_formula_has_no_value_it_says_why(text: str, says: str):
    with pytest.raises(ValueError, match=says):
        Expression(text).at(0.0)
