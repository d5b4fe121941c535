"""What a user's path may lead to, and what of it is read."""

import os
import socket
import struct
import zipfile

import pytest

from jaxgrasp.core import UserError, check_file, open_archive, open_file, read_file, read_member


@pytest.fixture
def odd(tmp_path):
    """Paths that lead to no regular file, and what is said about them."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "empty").touch()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "s"))
    yield {
        tmp_path: "is a directory; name a file in it",
        tmp_path / "pipe": "is a pipe, not a file",
        tmp_path / "link": "is a device, not a file",
        tmp_path / "loop": "cannot be read: Too many levels of symbolic links",
        tmp_path / "s": "is a socket, not a file",
        tmp_path / "empty": "is empty",
        tmp_path / "none": "no such file",
        tmp_path / "empty" / "below": "no such file",
        tmp_path / ("n" * 300): "cannot be read: File name too long",
        "/dev/full": "is a device",
        "a\0b": "cannot be read",
    }
    listener.close()


@pytest.mark.parametrize("reader", [check_file, open_file, read_file])
def test_what_is_no_file_gets_one_line_at_once(odd, reader):
    for path, message in odd.items():
        with pytest.raises(UserError, match=message) as error:
            reader(path, 1000)
        assert len(str(error.value).splitlines()) == 1


def test_the_cap_is_exact_and_told(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"x" * 2048)
    assert check_file(path, 2048) == 2048 and len(read_file(path, 2048)) == 2048
    with pytest.raises(UserError, match=r"has 2 KiB; at most 1\.999 KiB are read"):
        read_file(path, 2047)
    with path.open("r+b") as file:
        file.truncate(5 << 40)  # a sparse file
    with pytest.raises(UserError, match="has 5 TiB"):
        check_file(path, 1 << 30)


def archive_of(path, members, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def members_of(path, most=1 << 20, members=4):
    with open_file(path, 1 << 30) as file, open_archive(path, file, most, members) as archive:
        return {name: read_member(path, archive, name) for name in archive.namelist()}


def test_archives_are_read_up_to_their_bounds(tmp_path):
    members = {"a": b"1" * 5000, "b": b""}
    path = archive_of(tmp_path / "a.zip", members)
    assert members_of(path) == members
    assert members_of(path, most=5000, members=2) == members
    with pytest.raises(UserError, match=r"unpacks to 4\.883 KiB; at most 4\.882 KiB"):
        members_of(path, most=4999)
    with pytest.raises(UserError, match="2 members; at most 1"):
        members_of(path, members=1)


def test_archives_that_burst_are_refused(tmp_path):
    bomb = archive_of(tmp_path / "bomb", {"a": b"\0" * (64 << 20)})
    assert bomb.stat().st_size < 100_000
    with pytest.raises(UserError, match="unpacks to 64 MiB"):
        members_of(bomb)
    data = bomb.read_bytes()
    lying = tmp_path / "lying"  # its headers say 100 bytes
    lying.write_bytes(data.replace(struct.pack("<I", 64 << 20), struct.pack("<I", 100)))
    with pytest.raises(UserError, match="is damaged: Bad CRC-32"):
        members_of(lying)
    many = archive_of(tmp_path / "many", {str(i): b"" for i in range(200)})
    with pytest.raises(UserError, match="its directory is too long"):
        members_of(many)
    end = data.rfind(b"PK\x05\x06")
    (tmp_path / "large").write_bytes(data[:end] + b"PK\x06\x07" + bytes(16) + data[end:])
    with pytest.raises(UserError, match="its directory is too long"):
        members_of(tmp_path / "large")


def test_archives_packed_in_other_ways_and_broken_ones(tmp_path):
    strange = archive_of(tmp_path / "lzma", {"a": b"1"}, zipfile.ZIP_LZMA)
    with pytest.raises(UserError, match="compressed in a way that is not read"):
        members_of(strange)
    good = archive_of(tmp_path / "good", {"a": bytes(range(256)) * 40}).read_bytes()
    for cut in range(0, len(good), 7):
        (tmp_path / "cut").write_bytes(good[:cut] or b"P")
        with pytest.raises(UserError):
            members_of(tmp_path / "cut")
