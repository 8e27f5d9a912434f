"""Files that others wrote: only ordinary ones are read, and never beyond reason."""

from __future__ import annotations

import os
import socket
import tomllib
from pathlib import Path

import pytest

from measure.errors import SessionError
from measure.reading import check_ordinary, parse_toml, read_bytes, read_text


def test_an_ordinary_file_is_read_also_through_a_link(tmp_path: Path) -> None:
    file, link = tmp_path / "a.txt", tmp_path / "b.txt"
    file.write_bytes(b"\xef\xbb\xbfone\r\ntwo\rthree\n")
    link.symlink_to(file)
    for path in (file, link):
        assert check_ordinary(path, SessionError) == 18
        assert read_text(path, SessionError) == "one\ntwo\nthree\n"


def test_what_is_no_ordinary_file_is_refused_unread(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        (tmp_path / "link").symlink_to("/dev/zero")
        for path, what in (
            (tmp_path / "pipe", "a pipe"),
            (tmp_path / "socket", "a socket"),
            (tmp_path / "link", "a device"),
            (Path("/dev/zero"), "a device"),
            (tmp_path, "a folder"),
        ):
            with pytest.raises(SessionError, match=f"where: {path}: is {what}, not an ordinary"):
                check_ordinary(path, SessionError, "where: ")
            with pytest.raises(SessionError, match=f"is {what}"):
                read_text(path, SessionError)


def test_links_that_lead_nowhere(tmp_path: Path) -> None:
    (tmp_path / "round").symlink_to(tmp_path / "round")
    (tmp_path / "gone").symlink_to(tmp_path / "nothing")
    with pytest.raises(SessionError, match="round: cannot be read: Too many levels"):
        check_ordinary(tmp_path / "round", SessionError)
    with pytest.raises(SessionError, match="gone: no such file or folder: it is a link"):
        check_ordinary(tmp_path / "gone", SessionError)


def test_a_name_that_no_file_can_have() -> None:
    with pytest.raises(SessionError, match=r"cannot be read: (stat: )?embedded null"):
        check_ordinary(Path("a\0b"), SessionError)
    with pytest.raises(SessionError, match="cannot be read: File name too long"):
        check_ordinary(Path("x" * 5000), SessionError)


def test_a_file_beyond_reason_takes_no_memory(tmp_path: Path) -> None:
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(SessionError, match="has 1099511627776 bytes, and 1000 are the most"):
        read_bytes(tmp_path / "huge", SessionError, 1000)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 100_000, "nested too deep"),
        ("a = " + "{b = " * 5_000 + "1" + "}" * 5_000, "nested too deep"),
        ("a." * 5_000 + "b = 1", "nested too deep"),
        ("a = " + "9" * 5_000, "too many digits"),
        ("a = [1,", "Invalid value"),
    ],
)
def test_toml_beyond_reason(text: str, words: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError, match=words):
        parse_toml(text)


def test_toml_within_reason() -> None:
    assert parse_toml("a.b.c = [[1], [[2]]]\nd = " + "9" * 400)["a"]["b"]["c"] == [[1], [[2]]]
