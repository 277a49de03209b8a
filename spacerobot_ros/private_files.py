"""Files that are executed, flown or resumed: read only where no other user could have written them.

A :class:`Cache` keeps what can be made again. What it returns is complete and was written by this
user. It treats every other file as if it were not there, and warns once.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import pwd
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from spacerobot_ros.errors import SpaceRobotError

_LOG = logging.getLogger(__name__)

_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH

_MAGIC = b"spacerobot_ros cache 2"
"""Begins the last line of a file of the cache; the number is that of the format."""

_LARGEST = 256 * 2**20
"""No file that is read here is longer, bytes."""

_reported: set[str] = set()


class UntrustedFileError(SpaceRobotError):
    """A file or folder that others may have altered; the sentence says how to mend it."""


def warn_once(sentence: str) -> None:
    """Log a warning the first time that it comes up in this process."""
    if sentence not in _reported:
        _reported.add(sentence)
        _LOG.warning("%s", sentence)


def read_private(path: Path, *, follow: bool = False) -> bytes:
    """Return the content of a file that only this user, or root, can have written.

    Parameters
    ----------
    path
        The file.
    follow
        Whether it may be a symbolic link.

    Raises
    ------
    OSError
        It cannot be read, or is a symbolic link (ELOOP).
    UntrustedFileError
        It is no regular file, belongs to another user, or others may write it.
    """
    # A FIFO without a writer would hold up an open that waits.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW)
    with os.fdopen(os.open(path, flags), "rb") as file:
        # The facts are those of the file that is read, whatever becomes of its name meanwhile.
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode):
            raise UntrustedFileError(f"'{path}' is not a regular file; remove it.")
        _require_own(path, facts)
        if facts.st_size > _LARGEST:
            raise UntrustedFileError(f"'{path}' has {facts.st_size} bytes; remove it.")
        return file.read(_LARGEST)


def write_whole(path: Path, content: bytes, *, durable: bool = True) -> None:
    """Replace a file as a whole or not at all; it is this user's alone.

    Parameters
    ----------
    path, content
        The file, and what it is to hold.
    durable
        Whether to wait until the disk has it, so that it is whole after a loss of power, too.

    Raises
    ------
    OSError
        It cannot be written; what was there before stays.
    """
    # Made with mode 600, whatever the umask, under a name that nobody can foresee.
    number, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".new")
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise
    if not durable:
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def trusted_folder(folder: Path) -> Path:
    """Return where a folder really is, if only this user, or root, can have put files into it.

    Raises
    ------
    OSError
        It is not there.
    UntrustedFileError
        It belongs to another user, others may write it, or others may put another in its place.
    """
    if folder.is_symlink():
        _require_own(folder, os.lstat(folder), link=True)
    real = folder.resolve(strict=True)
    if not real.is_dir():
        raise UntrustedFileError(f"'{folder}' is not a folder; remove it.")
    _require_own(real, real.stat())
    for parent in real.parents:
        mode = parent.stat().st_mode
        # In a folder with the sticky bit, as /tmp, no user renames what belongs to another.
        if mode & _OTHERS_MAY_WRITE and not mode & stat.S_ISVTX:
            raise UntrustedFileError(_writable(parent, mode))
    return real


def _require_own(path: Path, facts: os.stat_result, *, link: bool = False) -> None:
    if facts.st_uid not in (0, os.geteuid()):
        raise UntrustedFileError(f"'{path}' belongs to {_user(facts.st_uid)}; use one of your own.")
    if not link and facts.st_mode & _OTHERS_MAY_WRITE:
        raise UntrustedFileError(_writable(path, facts.st_mode))


def _writable(path: Path, mode: int) -> str:
    return (
        f"others may write '{path}' (mode {stat.S_IMODE(mode):o}); make it yours alone with "
        f"chmod go-w '{path}'."
    )


def _user(number: int) -> str:
    try:
        return f"user {number} ({pwd.getpwuid(number).pw_name})"
    except KeyError:
        return f"user {number}"


class Cache:
    """A folder of files that can be made again; nothing that happens to it raises anything.

    A file ends with a line that holds the key that its content was made for, its length and its
    SHA-256; one that is altered, cut or of something else is deleted. Its folder and it itself
    must belong to this user and be writable by no other; else they are not used, and a warning
    says so.

    Parameters
    ----------
    folder
        Made where it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self, name: str, key: str) -> tuple[Path, bytes] | None:
        """Return where a file is and what was stored in it under this key, or None."""
        try:
            path = trusted_folder(self.folder) / name
        except UntrustedFileError as error:
            self._refuse(error)
            return None
        except OSError:
            return None
        try:
            return path, _checked(read_private(path), key)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, UntrustedFileError) as error:
            self.discard(name, _plain(error) if isinstance(error, OSError) else str(error))
            return None

    def store(self, name: str, key: str, content: bytes) -> Path | None:
        """Store a content under a key; return where it is, None if it cannot be stored."""
        try:
            _make(self.folder)
            path = trusted_folder(self.folder) / name
            write_whole(path, content + _trailer(content, key))
        except UntrustedFileError as error:
            self._refuse(error)
            return None
        except OSError as error:
            warn_once(f"Nothing can be kept in the cache '{self.folder}': {_plain(error)}.")
            return None
        return path

    def discard(self, name: str, why: str) -> None:
        """Delete a file that is no good, and say why."""
        path = self.folder / name
        warn_once(f"'{path}' is thrown away and made anew: {why.rstrip('.')}.")
        with suppress(OSError):
            path.unlink()

    def _refuse(self, error: UntrustedFileError) -> None:
        warn_once(
            f"The cache '{self.folder}' is not used, for its files are executed and flown: {error} "
            "(SPACEROBOT_CACHE_DIR chooses another folder.)"
        )


def _plain(error: OSError) -> str:
    if error.errno == errno.ELOOP:
        return "it is a symbolic link"
    return error.strerror or str(error)


def _make(folder: Path) -> None:
    """Make a folder and what it is in, for this user alone whatever the umask."""
    for each in (*reversed(folder.parents), folder):
        if not each.exists():
            with suppress(FileExistsError):
                each.mkdir(mode=0o700)


def _trailer(content: bytes, key: str) -> bytes:
    digest = hashlib.sha256(content).hexdigest()
    return b"\n%s %s %d %s\n" % (_MAGIC, key.encode(), len(content), digest.encode())


def _checked(whole: bytes, key: str) -> bytes:
    """Return the content of a file without its last line.

    Raises
    ------
    ValueError
        The line is not that of this content and key.
    """
    content = whole[: whole.rfind(b"\n" + _MAGIC + b" ")]
    if not whole.endswith(_trailer(content, key)):
        raise ValueError("it is damaged, or of something else")
    return content
