"""Form of the section `recording` of a robot file."""

from dxlrun.description.base_form import Form, key
from dxlrun.description.units import SizeOrDuration
from dxlrun.features.feature import Section


class Recording(Form):
    """Form of `recording`: where logs are written, when they are split, and which are deleted."""

    directory: str = key(
        "Directory of the logs, relative to the working directory.", "logs", "logs", min_length=1
    )
    split: SizeOrDuration | None = key(
        "Size or duration after which a log continues in a new file, at least 1 MB or 1 s.", "100 MB", None
    )
    keep: SizeOrDuration | None = key(
        "Limit for old data. Beyond a size, the oldest logs in the directory are deleted at the end "
        "of a run. Beyond a duration (needs `split`), older files of the log are deleted during the "
        "run.",
        "10 GB",
        None,
    )


STAGE: Section[Recording] = Section(
    "recording",
    Recording,
    key("Settings of the log.", "{directory: logs}", Recording.of_defaults()),
    before="processes",
)
