"""Form of the section `recording`."""

from __future__ import annotations

from dxlrun.description.form import Form, key
from dxlrun.description.units import SizeOrDuration
from dxlrun.features.feature import Section


class Recording(Form):
    """Settings of the log."""

    directory: str = key("Where logs are written, from the working directory.", "logs", "logs", min_length=1)
    split: SizeOrDuration | None = key(
        "Size or duration, 1 MB or 1 s at least, after which a log goes on in another file.", "100 MB", None
    )
    keep: SizeOrDuration | None = key(
        "A size: a run deletes the oldest logs in the directory beyond it at its end. A duration (needs "
        "split): files whose newest record is older are deleted while the run goes on.",
        "10 GB",
        None,
    )


STAGE: Section[Recording] = Section(
    "recording", Recording, key("The log.", "{directory: logs}", Recording()), before="processes"
)
