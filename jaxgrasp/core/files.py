"""The gate for files that a user names: regular files of a bounded size, and archives that cannot burst.

A path may lead anywhere: to a pipe that nobody writes to, an endless device, a folder, a link to one of these. What is
not a regular file is refused before a byte is read, with one line that says so.
"""

from __future__ import annotations

import os
import stat
import zlib
from typing import BinaryIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from .errors import UserError

__all__ = ["check_file", "open_archive", "open_file", "read_file", "read_member"]

KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}
END_OF_DIRECTORY, END_BYTES, LONGEST_COMMENT = b"PK\x05\x06", 22, 0xFFFF
LARGE_LOCATOR, LOCATOR_BYTES = b"PK\x06\x07", 20  # of archives with more than 4 GiB or 65535 members
ENTRY_BYTES = 1 << 10  # of the directory, for one member: more than any name of ours


def check_file(path: str | os.PathLike, most: int) -> int:
    """The bytes of the file: 1 to ``most``. UserError where the path leads to anything but such a regular file."""
    try:
        known = os.stat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise UserError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    return _fit(path, known, most)


def _fit(path: str | os.PathLike, known: os.stat_result, most: int) -> int:
    kind = stat.S_IFMT(known.st_mode)
    if kind == stat.S_IFDIR:
        raise UserError(f"{path} is a directory; name a file in it")
    if kind != stat.S_IFREG:
        raise UserError(
            f"{path} is {KINDS.get(kind, 'something')}, not a file; copy what it holds to a file first"
        )
    if not known.st_size:
        raise UserError(f"{path} is empty")
    if known.st_size > most:
        raise UserError(f"{path} has {_size(known.st_size)}; at most {_size(most)} are read")
    return known.st_size


def _size(count: int) -> str:
    unit = max(0, min(4, (count.bit_length() - 1) // 10))
    return f"{count / (1 << (10 * unit)):.4g} {('bytes', 'KiB', 'MiB', 'GiB', 'TiB')[unit]}"


def open_file(path: str | os.PathLike, most: int) -> BinaryIO:
    """The file, open for reading. UserError as of ``check_file``."""
    check_file(path, most)  # before it is opened: opening a device may already do something
    try:
        # Should the path have changed since: a pipe without a writer does not keep us waiting.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        file = os.fdopen(os.open(path, flags), "rb")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from error
    try:
        _fit(path, os.fstat(file.fileno()), most)
    except BaseException:
        file.close()
        raise
    return file


def read_file(path: str | os.PathLike, most: int) -> bytes:
    """All bytes of the file. UserError as of ``check_file``."""
    with open_file(path, most) as file:
        try:
            data = file.read(most + 1)
        except OSError as error:
            raise UserError(f"{path} cannot be read: {error.strerror or error}") from error
    if len(data) > most:  # it grew, or the system does not know sizes there
        raise UserError(f"{path} has more than {_size(most)}; no more are read")
    return data


def open_archive(path: str | os.PathLike, file: BinaryIO, most: int, members: int) -> ZipFile:
    """The zip archive in ``file``: at most so many ``members``, which unpack to at most ``most`` bytes together.

    path  what it is called in messages. UserError where it is none, or a larger one; nothing is unpacked yet.
    """
    try:
        _bounded_directory(file, members)
        archive = ZipFile(file)
    except (BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise UserError(f"{path} is not a complete zip archive: {error}") from error
    found = archive.infolist()
    if len(found) > members:
        raise UserError(f"{path} has {len(found)} members; at most {members} are read")
    total = sum(member.file_size for member in found)
    if total > most:
        raise UserError(f"{path} unpacks to {_size(total)}; at most {_size(most)} are read")
    if any(
        member.compress_type not in (ZIP_STORED, ZIP_DEFLATED) or member.flag_bits & 1 for member in found
    ):
        raise UserError(f"{path} is encrypted, or compressed in a way that is not read; pack it plainly")
    return archive


def _bounded_directory(file: BinaryIO, members: int) -> None:
    """BadZipFile where the directory is longer than ``members`` need: ``ZipFile`` reads it whole."""
    end = file.seek(0, os.SEEK_END)
    file.seek(max(0, end - END_BYTES - LONGEST_COMMENT - LOCATOR_BYTES))
    tail = file.read(END_BYTES + LONGEST_COMMENT + LOCATOR_BYTES)
    file.seek(0)
    at = tail.rfind(END_OF_DIRECTORY)
    if at < 0:
        raise BadZipFile("its directory is missing")
    length = int.from_bytes(tail[at + 12 : at + 16], "little")
    if length > members * ENTRY_BYTES or LARGE_LOCATOR in tail[max(0, at - LOCATOR_BYTES) : at]:
        raise BadZipFile("its directory is too long")


def read_member(path: str | os.PathLike, archive: ZipFile, member: ZipInfo | str) -> bytes:
    """The bytes of one member, whose length ``open_archive`` bounds. UserError where they are damaged."""
    try:
        known = archive.getinfo(member) if isinstance(member, str) else member
        with archive.open(known) as stream:
            return stream.read(known.file_size)  # without a number it would unpack what the directory denies
    except (BadZipFile, OSError, EOFError, KeyError, ValueError, RuntimeError, zlib.error) as error:
        reason = str(error.args[0]) if error.args else type(error).__name__
        raise UserError(f"{path} is damaged: {reason}") from error
