"""Every property draws the same examples at each run; a random search is asked for by its profile.

A find of a fixed run repeats itself: run the test again. A random search prints how to repeat its find:

    python -m pytest --hypothesis-profile=search tests/description
"""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("fixed", derandomize=True, print_blob=True)
settings.register_profile("search", derandomize=False, print_blob=True, max_examples=2000)
settings.load_profile("fixed")
