"""Every property draws the same examples at each run; a random search is asked for by its profile.

A find of a fixed run repeats itself: run the test again. A random search prints how to repeat its find:

    python -m pytest --hypothesis-profile=search tests/description
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, print_blob=True)
settings.register_profile("search", derandomize=False, print_blob=True, max_examples=2000)
settings.load_profile("fixed")


def _memories() -> set[int]:
    """The descriptors of memory without a name that this process has open."""
    found = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            if os.readlink(link).startswith("/memfd:"):
                found.add(int(link.name))
        except OSError:
            pass  # it was that of the folder itself
    return found


@pytest.fixture
def no_memory_left() -> Iterator[None]:
    """Close the descriptors of shared memory that a test leaves open: a process has some hundred of them."""
    before = _memories()
    yield
    for descriptor in _memories() - before:
        os.close(descriptor)
