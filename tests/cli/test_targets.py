"""Files that a user names for writing: what may be replaced, and what every verb refuses."""

import os
from pathlib import Path
from xml.etree.ElementTree import Element

import pytest
from tests.kit.commands import Dxlrun

from dxlrun.cli.inputs import check_report, write_report
from dxlrun.errors import InputError
from dxlrun.output.html_tree import document
from dxlrun.output.target import check_target, open_empty, write_target

MARK = "drawn by us"
KINDS = ("pipe", "directory", "device", "link to a text", "dangling link", "text")
TARGETS = {
    "schema.json": "schema --output",
    "graph.svg": "check robots/diff_drive.yaml --graph",
    "graph.dot": "check robots/diff_drive.yaml --graph",
    "frames.svg": "frames robots/diff_drive.yaml --graph",
    "seen.jsonl": "robots/diff_drive.yaml --virtual --duration 1 --ledger",
    "sim.jsonl": "sim robots/diff_drive.yaml --ledger",
    "robot.yaml": "scan /dev/none --output",
    "servo.json": "servo /dev/none 1 backup",
    "arms": "new-plugin arms",
    "report.html": "characterize robots/diff_drive.yaml --virtual --report",
    "joint.motor.yaml": "identify robots/diff_drive.yaml left_wheel_joint --virtual --output",
    "latency.mcap": "latency --log",
    "motion.yaml": "convert none.mcap",
}
"""A command that writes each file."""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(kind: str, path: Path) -> None:
    """Make what is in the way of a target."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/null")
    elif kind == "link to a text":
        path.with_name("text").write_text("Dear servo")
        path.symlink_to("text")
    elif kind == "dangling link":
        path.symlink_to("nowhere")
    else:
        path.write_text("Dear servo")


@pytest.mark.timeout(60)  # a pipe would be waited for without end
@pytest.mark.parametrize("kind", ["pipe", "text"])
@pytest.mark.parametrize("name", TARGETS)
def test_every_verb_refuses_to_replace_what_is_not_its_own(
    dxlrun: Dxlrun, reader: Path, name: str, kind: str
) -> None:
    made(kind, reader / name)
    before = sorted(path.name for path in reader.iterdir())
    said = dxlrun(*TARGETS[name].split(), name)
    assert said.code == 2
    assert f"{name} cannot be written (" in said.err, said.err
    assert "; choose another name" in said.err
    assert sorted(path.name for path in reader.iterdir()) == before
    assert kind == "pipe" or (reader / name).read_text() == "Dear servo"


@pytest.mark.parametrize("name", ["schema.json", "graph.svg", "graph.dot"])
def test_verb_replaces_what_it_wrote_before_and_an_empty_file(
    dxlrun: Dxlrun, reader: Path, name: str
) -> None:
    (reader / name).touch()
    for _ in range(2):
        assert dxlrun(*TARGETS[name].split(), name).code == 0
        assert len((reader / name).read_bytes()) > 100
    assert sorted(path.name for path in reader.iterdir()) == sorted(["robots", name])


def test_report_is_replaced_by_a_report(here: Path) -> None:
    page = document("a report", Element("header"), (), Element("footer"), {})
    for text in (page, page.replace("a report", "another one")):
        check_report(Path("report.html"), "json")
        write_report(Path("report.html"), text)
        assert (here / "report.html").read_text() == text
    (here / "report.html").write_text("<p>by hand</p>")
    with pytest.raises(InputError, match="was not written by dxlrun"):
        check_report(Path("report.html"), "json")


def test_older_file_of_the_same_kind_is_replaced_where_a_link_leads(here: Path) -> None:
    real, link = here / "real", here / "link"
    real.write_text(f"an older one, {MARK}")
    real.chmod(0o600)
    link.symlink_to("real")
    write_target(Path("link"), f"a newer one, {MARK}", MARK)
    assert real.read_text() == f"a newer one, {MARK}"
    assert (link.is_symlink(), real.stat().st_mode & 0o777) == (True, 0o600)
    with pytest.raises(InputError, match="it exists and was not written by dxlrun"):
        write_target(Path("link"), "", "drawn by others")


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("missing/a", "directory missing not found"),
        ("text/a", "Not a directory"),
        ("text", "it exists"),
        (".", "it exists and is a directory"),
    ],
)
def test_reason_is_in_the_sentence(here: Path, target: str, reason: str) -> None:
    (here / "text").write_text("Dear servo")
    with pytest.raises(InputError) as refused:
        check_target(Path(target))
    assert str(refused.value) == f"{target} cannot be written ({reason}); choose another name"


def test_full_disk_leaves_nothing(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(InputError, match=r"a cannot be written \(No space left on device\)"):
        write_target(Path("a"), "text")
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_replaces_what_dxlrun_did_not_write(here: Path, kind: str) -> None:
    made(kind, here / "target")
    for replaces in (None, MARK):
        with pytest.raises(InputError, match="target cannot be written"):
            write_target(Path("target"), "new", replaces)
    assert not list(here.glob(".*"))
    assert not kind.endswith("text") or Path("target").read_text() == "Dear servo"
    if kind == "dangling link":  # a file that grows begins empty
        os.close(open_empty("target", 0o600))
        assert (here / "nowhere").stat().st_size == 0
    elif kind != "device":
        with pytest.raises(OSError, match="target"):
            open_empty("target", 0o600)
