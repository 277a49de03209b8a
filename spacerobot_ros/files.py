"""Whole files, files that only this user can have written, and the cache.

A file is replaced as a whole or not at all, because disks get full and processes are killed.

Files that are executed, flown or resumed are read only where no other user of the machine could
have written them: the folder of the cache may be a shared one. A :class:`Cache` keeps files that
can be made again; it treats a damaged or untrusted file as missing, and warns once.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pwd
import secrets
import stat
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from spacerobot_ros.errors import SpaceRobotError

_LOG = logging.getLogger(__name__)

_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH

_CACHE_MAGIC = b"spacerobot_ros cache 2"
"""Beginning of the last line of a cache file, with the number of the file format."""

_MAX_PRIVATE_FILE_SIZE = 256 * 2**20
"""Largest file that :func:`read_private` reads, bytes."""

_MCAP_MAGIC = b"\x89MCAP"
"""First bytes of a bag."""

_MAX_YAML_CHARACTERS = 1_000_000
"""Largest number of characters of a YAML text."""

_MAX_YAML_VALUES = 100_000
"""Largest number of values of a YAML text, with those that aliases repeat."""

_MAX_YAML_DEPTH = 50
"""Largest number of levels of a YAML text."""

_logged_warnings: set[str] = set()


class UntrustedFileError(SpaceRobotError):
    """Other users may have altered a file or folder; the message states a remedy."""


def warn_once(message: str) -> None:
    """Log a warning, once in a process."""
    if message not in _logged_warnings:
        _logged_warnings.add(message)
        _LOG.warning("%s", message)


# -- whole files ------------------------------------------------------------------------------


def write_whole(path: Path, content: bytes, *, durable: bool = True, mode: int = 0o600) -> None:
    """Replace a file as a whole or not at all.

    Parameters
    ----------
    path, content
        The file and its new content.
    durable
        Whether to wait for the disk, so that the file is whole after a loss of power as well.
    mode
        Permissions of the file, without those that the umask forbids; by default only this user
        may read it.

    Raises
    ------
    OSError
        The file cannot be written; an older file stays.
    """
    new_file = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.new")
    try:
        with os.fdopen(os.open(new_file, os.O_CREAT | os.O_WRONLY | os.O_EXCL, mode), "wb") as file:
            file.write(content)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(new_file, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(new_file)
        raise
    if durable:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_output(path: Path, content: bytes | str, mode: int = 0o666) -> None:
    """Write a report, picture or result, and the folders above it, as a whole or not at all.

    ``mode`` are the permissions of a new file; an older file keeps its own. A bag is not replaced,
    because it may be the only record of a flight. Devices and pipes are written to. A text is
    written as UTF-8.

    Raises
    ------
    SpaceRobotError
        The file cannot be written, or is a bag; an older file stays.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_output(Path(os.path.realpath(path)), data, mode)
    except OSError as error:
        reason = error.strerror
        if isinstance(error, FileExistsError | NotADirectoryError):
            reason = f"{path.parent} is no folder"
        raise SpaceRobotError(f"The file {path} cannot be written: {reason}.") from error


def _write_output(path: Path, data: bytes, mode: int) -> None:
    before = path.stat() if path.exists() else None
    is_device = before is not None and not stat.S_ISREG(before.st_mode)
    if before is not None and not is_device:
        with path.open("rb") as file:
            if file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC:
                raise SpaceRobotError(
                    f"The file {path} is a bag, which is not replaced: name another."
                )
    if is_device or not os.access(path.parent, os.W_OK):
        path.write_bytes(data)
        return
    if before is not None:
        mode = stat.S_IMODE(before.st_mode)
    write_whole(path, data, durable=False, mode=mode)


# -- YAML -------------------------------------------------------------------------------------


def load_yaml(text: str, loader: Any = None) -> Any:
    """Return the content of a YAML text of unknown origin, whose size is limited.

    Parameters
    ----------
    text
        One document of at most a million characters.
    loader
        Class of the loader; None: ``yaml.SafeLoader``.

    Raises
    ------
    ValueError
        The text is no YAML or is too long, too deeply nested, or refers to itself; or its aliases
        stand for too much (a file of 1 kB may hold a thousand million values).
    """
    import yaml

    if len(text) > _MAX_YAML_CHARACTERS:
        raise ValueError(f"it has more than {_MAX_YAML_CHARACTERS} characters")
    try:
        reader = (loader or yaml.SafeLoader)(text)
        try:
            node = reader.get_single_node()
            if node is None:
                return None
            _count_values(node, {})
            return reader.construct_document(node)
        finally:
            reader.dispose()
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _count_values(node: Any, sizes: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """Return the number of values that a node stands for, and its depth.

    ``sizes`` has those of nodes by their id, and None for the nodes around this one.
    """
    if id(node) not in sizes:
        sizes[id(node)] = None
        children = () if isinstance(node.value, str) else node.value
        count, depth = 1, 0
        for child in children:
            for each in child if isinstance(child, tuple) else (child,):
                child_count, child_depth = _count_values(each, sizes)
                count, depth = count + child_count, max(depth, child_depth)
            if count > _MAX_YAML_VALUES:
                raise ValueError(f"its aliases stand for more than {_MAX_YAML_VALUES} values")
        if depth >= _MAX_YAML_DEPTH:
            raise ValueError("it is nested too deeply")
        sizes[id(node)] = count, depth + 1
    size = sizes[id(node)]
    if size is None:
        raise ValueError("it refers to itself")
    return size


# -- files of this user -----------------------------------------------------------------------


def read_private(path: Path) -> bytes:
    """Return the content of a file that only this user, or root, can have written.

    Raises
    ------
    OSError
        It cannot be read.
    UntrustedFileError
        It belongs to another user, or others may write it, or it is too large.
    """
    # Opening a pipe of another user would block.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
        # The open file is checked, because its name may stand for another file by now.
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode):
            raise UntrustedFileError(f"'{path}' is not a regular file; remove it.")
        _require_own_path(path, facts)
        if facts.st_size > _MAX_PRIVATE_FILE_SIZE:
            raise UntrustedFileError(f"'{path}' has {facts.st_size} bytes; remove it.")
        return file.read(facts.st_size)


def trusted_folder(folder: Path) -> Path:
    """Return the resolved path of a folder into which only this user, or root, can write.

    Raises
    ------
    OSError
        There is no such folder.
    UntrustedFileError
        It belongs to another user, others may write it, or others may replace it.
    """
    real = folder.resolve(strict=True)
    if not real.is_dir():
        raise UntrustedFileError(f"'{folder}' is not a folder; remove it.")
    _require_own_path(real, real.stat())
    for parent in real.parents:
        mode = parent.stat().st_mode
        # In a folder with the sticky bit, such as /tmp, users cannot rename each other's files.
        if mode & _OTHERS_MAY_WRITE and not mode & stat.S_ISVTX:
            raise UntrustedFileError(_writable_by_others(parent, mode))
    return real


def _require_own_path(path: Path, facts: os.stat_result) -> None:
    if facts.st_uid not in (0, os.geteuid()):
        raise UntrustedFileError(
            f"'{path}' belongs to {_user_name(facts.st_uid)}; use one of your own."
        )
    if facts.st_mode & _OTHERS_MAY_WRITE:
        raise UntrustedFileError(_writable_by_others(path, facts.st_mode))


def _writable_by_others(path: Path, mode: int) -> str:
    return (
        f"others may write '{path}' (mode {stat.S_IMODE(mode):o}); make it yours alone with "
        f"chmod go-w '{path}'."
    )


def _user_name(number: int) -> str:
    try:
        return f"user {number} ({pwd.getpwuid(number).pw_name})"
    except KeyError:
        return f"user {number}"


class Cache:
    """A folder of files that can be computed again. Its methods log warnings instead of raising.

    The last line of a file holds its key, length and SHA-256, against disks that get full and
    processes that are killed. The folder and the file must belong to this user, and no other user
    may write them, because they are executed and flown.

    Parameters
    ----------
    folder
        Made where it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self, name: str, key: str) -> tuple[Path, bytes] | None:
        """Return path and content of a file stored under this key; None without one."""
        try:
            path = trusted_folder(self.folder) / name
        except UntrustedFileError as error:
            self._warn_of_untrusted_cache(error)
            return None
        except OSError:
            return None
        try:
            return path, _content_of_entry(read_private(path), key)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, UntrustedFileError) as error:
            self.discard(
                name, _os_error_reason(error) if isinstance(error, OSError) else str(error)
            )
            return None

    def store(self, name: str, key: str, content: bytes) -> Path | None:
        """Store content under a key; return its path, None if storing failed."""
        try:
            _make_private_folder(self.folder)
            path = trusted_folder(self.folder) / name
            write_whole(path, content + _trailer(content, key))
        except UntrustedFileError as error:
            self._warn_of_untrusted_cache(error)
            return None
        except OSError as error:
            warn_once(
                f"Nothing can be kept in the cache '{self.folder}': {_os_error_reason(error)}."
            )
            return None
        return path

    def discard(self, name: str, reason: str) -> None:
        """Delete a cached file and log the reason as a warning."""
        path = self.folder / name
        warn_once(f"'{path}' is deleted and computed again: {reason.rstrip('.')}.")
        with suppress(OSError):
            path.unlink()

    def _warn_of_untrusted_cache(self, error: UntrustedFileError) -> None:
        warn_once(
            f"The cache '{self.folder}' is not used, for its files are executed and flown: {error} "
            "(SPACEROBOT_CACHE_DIR chooses another folder.)"
        )


def warn_first_time(logger: logging.Logger, folder: Path, name: str, message: str) -> None:
    """Log a warning that is given once an installation; afterwards it is logged for debugging.

    Parameters
    ----------
    folder
        The cache, which remembers under ``name`` that the warning was given. Where it cannot, the
        warning is given each time.
    """
    cache = Cache(folder)
    # Installations that share a cache have a file each.
    entry = f"{name}-{hashlib.sha256(sys.prefix.encode()).hexdigest()[:32]}"
    known = cache.load(entry, sys.prefix) is not None
    logger.log(logging.DEBUG if known else logging.WARNING, message)
    if not known:
        cache.store(entry, sys.prefix, b"")


def _os_error_reason(error: OSError) -> str:
    return error.strerror or str(error)


def _make_private_folder(folder: Path) -> None:
    """Make a folder and the folders above it, for this user alone whatever the umask."""
    for each in (*reversed(folder.parents), folder):
        if not each.exists():
            with suppress(FileExistsError):
                each.mkdir(mode=0o700)


def _trailer(content: bytes, key: str) -> bytes:
    digest = hashlib.sha256(content).hexdigest()
    return b"\n%s %s %d %s\n" % (_CACHE_MAGIC, key.encode(), len(content), digest.encode())


def _content_of_entry(whole: bytes, key: str) -> bytes:
    """Return a cached file without its last line; ValueError if the line does not match."""
    content = whole[: whole.rfind(b"\n" + _CACHE_MAGIC + b" ")]
    if not whole.endswith(_trailer(content, key)):
        raise ValueError("it is damaged, or stored under another key")
    return content
