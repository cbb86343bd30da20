"""Facts that a kept state depends on: which change makes it unusable."""

import pytest

from dxlrun.channels.kept import difference

GEARED = {"elbow model": "MX-64", "elbow gear": "2"}


@pytest.mark.parametrize(
    ("then", "now", "told"),
    [
        (GEARED, GEARED, ""),
        (GEARED, GEARED | {"elbow gear": "3"}, "elbow gear was 2, now 3"),
        (GEARED, {"elbow model": "MX-64"}, "elbow gear was 2, now absent"),
        ({"elbow model": "MX-64"}, GEARED, "elbow gear was absent, now 2"),
    ],
)
def test_each_fact_that_changed_came_or_went_is_a_difference(then, now, told):
    assert difference(then, now) == told
