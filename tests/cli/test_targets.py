"""Files that a user names for writing: what may be replaced, and what every verb refuses."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

import pytest

from dxlrun.cli.inputs import check_report, write_report
from dxlrun.errors import InputError
from dxlrun.output.html_tree import document
from dxlrun.output.target import check_target, open_empty, write_target

Dxlrun = Callable[..., object]
ROBOT = Path(__file__).resolve().parents[2] / "robots/diff_drive.yaml"
MARK = "drawn by us"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(kind: str, path: Path) -> None:
    """Make what stands in the way of a target."""
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


KINDS = ("pipe", "directory", "device", "link to a text", "dangling link", "text")


@pytest.mark.timeout(60)  # a pipe would be waited for without end
@pytest.mark.parametrize("kind", ["pipe", "text"])
@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("schema", "--output"), "schema.json"),
        (("check", ROBOT, "--graph"), "graph.svg"),
        (("check", ROBOT, "--graph"), "graph.dot"),
        (("frames", ROBOT, "--graph"), "frames.svg"),
        ((ROBOT, "--virtual", "--duration", "1", "--ledger"), "seen.jsonl"),
        (("sim", ROBOT, "--ledger"), "seen.jsonl"),
        (("scan", "/dev/none", "--output"), "robot.yaml"),
        (("servo", "/dev/none", "1", "backup"), "servo.json"),
        (("new-plugin", "arms"), "arms"),
        (("characterize", ROBOT, "--virtual", "--report"), "report.html"),
        (("identify", ROBOT, "left_wheel_joint", "--virtual", "--output"), "joint.motor.yaml"),
        (("latency", "--log"), "latency.mcap"),
        (("convert", "none.mcap"), "motion.yaml"),
    ],
)
def test_every_verb_refuses_to_replace_what_is_not_its_own(
    dxlrun: Dxlrun, here: Path, words: tuple[object, ...], name: str, kind: str
) -> None:
    made(kind, here / name)
    before = sorted(path.name for path in here.iterdir())
    said = dxlrun(*words, name)
    assert said.code == 2
    assert f"{name} cannot be written (" in said.err, said.err
    assert "; choose another name" in said.err
    assert sorted(path.name for path in here.iterdir()) == before
    if "text" in kind:
        assert (here / name).read_text() == "Dear servo"


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("schema", "--output"), "schema.json"),
        (("check", ROBOT, "--graph"), "graph.svg"),
        (("check", ROBOT, "--graph"), "graph.dot"),
    ],
)
def test_a_verb_replaces_what_it_wrote_before_and_an_empty_file(
    dxlrun: Dxlrun, here: Path, words: tuple[object, ...], name: str
) -> None:
    (here / name).touch()
    for _ in range(2):
        assert dxlrun(*words, name).code == 0
        assert len((here / name).read_bytes()) > 100
    assert [path.name for path in here.iterdir()] == [name]


def test_a_report_is_replaced_by_a_report(here: Path) -> None:
    page = document("a report", Element("header"), (), Element("footer"), {})
    for text in (page, page.replace("a report", "another one")):
        check_report(Path("report.html"), "json")
        write_report(Path("report.html"), text)
        assert (here / "report.html").read_text() == text
    (here / "report.html").write_text("<p>by hand</p>")
    with pytest.raises(InputError, match="was not written by dxlrun"):
        check_report(Path("report.html"), "json")


def test_an_older_file_of_the_same_kind_is_replaced_where_a_link_leads(here: Path) -> None:
    (here / "real").write_text(f"an older one, {MARK}")
    (here / "real").chmod(0o600)
    (here / "link").symlink_to("real")
    write_target(Path("link"), f"a newer one, {MARK}", MARK)
    assert (here / "real").read_text() == f"a newer one, {MARK}"
    assert ((here / "link").is_symlink(), (here / "real").stat().st_mode & 0o777) == (True, 0o600)
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
def test_the_reason_is_in_the_sentence(here: Path, target: str, reason: str) -> None:
    (here / "text").write_text("Dear servo")
    with pytest.raises(InputError) as refused:
        check_target(Path(target))
    assert str(refused.value) == f"{target} cannot be written ({reason}); choose another name"


def test_a_full_disk_leaves_nothing(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(InputError, match=r"a cannot be written \(No space left on device\)"):
        write_target(Path("a"), "text")
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("replaces", [None, MARK])
def test_nothing_takes_the_place_of_what_dxlrun_did_not_write(
    here: Path, kind: str, replaces: str | None
) -> None:
    made(kind, here / "target")
    with pytest.raises(InputError, match="target cannot be written"):
        write_target(Path("target"), "new", replaces)
    assert not list(here.glob(".*"))
    assert not kind.endswith("text") or Path("target").read_text() == "Dear servo"


@pytest.mark.parametrize("kind", sorted({*KINDS} - {"device"}))
def test_a_file_that_grows_begins_empty(here: Path, kind: str) -> None:
    made(kind, here / "log")
    if kind == "dangling link":
        os.close(open_empty("log", 0o600))
        assert (here / "nowhere").stat().st_size == 0
        return
    with pytest.raises(OSError, match="log"):
        open_empty("log", 0o600)
