from __future__ import annotations

from dxlrun.description.document import Marks
from dxlrun.errors import Mark

MARKS = Marks(
    "f.yaml",
    values={(): Mark("f.yaml", 2, 1), ("a",): Mark("f.yaml", 3, 3), ("a", 0): Mark("f.yaml", 3, 5)},
    keys={("a",): Mark("f.yaml", 2, 1)},
)


def test_key_and_value_have_their_own_place() -> None:
    assert MARKS.key("a") == Mark("f.yaml", 2, 1)
    assert MARKS.value("a") == Mark("f.yaml", 3, 3)


def test_the_item_of_a_list_has_only_a_value() -> None:
    assert MARKS.key("a", 0) == MARKS.value("a", 0) == Mark("f.yaml", 3, 5)


def test_what_is_not_in_the_file_stands_at_its_nearest_parent() -> None:
    assert MARKS.value("a", 7, "x") == Mark("f.yaml", 2, 1)
    assert MARKS.key("nowhere") == Mark("f.yaml", 2, 1)
    assert Marks("f.yaml", {}, {}).value("a") == Mark("f.yaml", 1, 1)
