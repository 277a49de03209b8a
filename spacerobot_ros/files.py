"""Atomic file replacement, untrusted YAML, files that no other user can have modified, and the
cache."""

from __future__ import annotations

import hashlib
import logging
import os
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
"""Prefix of the last line in a cache file, with the file format version."""

_MCAP_MAGIC = b"\x89MCAP"
_MAX_YAML_CHARACTERS = 1_000_000

_MAX_YAML_VALUES = 100_000
"""Maximum number of values in a YAML string, including values repeated by aliases."""

_logged_warnings: set[str] = set()


class UntrustedFileError(SpaceRobotError):
    """Other users may have altered a file or folder; the message states a remedy."""


def warn_once(message: str) -> None:
    """Log a warning, once per process."""
    if message not in _logged_warnings:
        _logged_warnings.add(message)
        _LOG.warning("%s", message)


# -- whole files ------------------------------------------------------------------------------


def write_whole(path: Path, content: bytes, *, mode: int = 0o600) -> None:
    """Replace a file atomically.

    Parameters
    ----------
    path, content
        The file and its new content.
    mode
        File permissions, masked by the umask; by default only this user may read it.

    Raises
    ------
    OSError
        The file cannot be written; an existing file is kept.
    """
    new_file = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.new")
    try:
        with os.fdopen(os.open(new_file, os.O_CREAT | os.O_WRONLY | os.O_EXCL, mode), "wb") as file:
            file.write(content)
        os.replace(new_file, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(new_file)
        raise


def write_output(path: Path, content: bytes | str) -> None:
    """Write a report, picture or result, completely or not at all; create its folders.

    An existing file keeps its permissions. A bag is not replaced, because it may be the only record
    of a flight. Devices and pipes are supported. Text is written as UTF-8.

    Raises
    ------
    SpaceRobotError
        The file cannot be written, or is a bag; an existing file is kept.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        target = Path(os.path.realpath(path))
        before = target.stat() if target.exists() else None
        mode, is_device = 0o666, before is not None and not stat.S_ISREG(before.st_mode)
        if before is not None and not is_device:
            mode = stat.S_IMODE(before.st_mode)
            with target.open("rb") as file:
                if file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC:
                    raise SpaceRobotError(
                        f"The file {target} is a bag, which is not overwritten: choose another "
                        "file."
                    )
        if is_device or not os.access(target.parent, os.W_OK):
            target.write_bytes(data)
        else:
            write_whole(target, data, mode=mode)
    except OSError as error:
        reason = error.strerror
        if isinstance(error, FileExistsError | NotADirectoryError):
            reason = f"{path.parent} is not a folder"
        raise SpaceRobotError(f"The file {path} cannot be written: {reason}.") from error


# -- YAML -------------------------------------------------------------------------------------


def load_yaml(text: str) -> Any:
    """Return the content of an untrusted YAML string, with limits on its size.

    Parameters
    ----------
    text
        One document of at most a million characters.

    Raises
    ------
    ValueError
        The string is not YAML, has a key twice, of which YAML would silently keep the last, is too
        long or too deeply nested, or its aliases expand to too many values: a 1 kB file may expand
        to a billion values.
    """
    import yaml

    if len(text) > _MAX_YAML_CHARACTERS:
        raise ValueError(f"it has more than {_MAX_YAML_CHARACTERS} characters")
    try:
        reader = yaml.SafeLoader(text)
        try:
            node = reader.get_single_node()
            if node is None:
                return None
            _check_values(node)
            return reader.construct_document(node)
        finally:
            reader.dispose()
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _check_values(root: Any) -> None:
    """Refuse a YAML node with a key twice or too many values below it; keys count as well."""
    nodes, count = [root], 0
    while nodes:
        count += 1
        if count > _MAX_YAML_VALUES:
            raise ValueError(
                f"it has more than {_MAX_YAML_VALUES} values, including values repeated by aliases"
            )
        node = nodes.pop()
        if node.id == "mapping":
            _refuse_repeated_keys(node)
        for child in () if isinstance(node.value, str) else node.value:
            nodes.extend(child if isinstance(child, tuple) else (child,))


def _refuse_repeated_keys(mapping: Any) -> None:
    known = set()
    for key, _ in mapping.value:
        if not isinstance(key.value, str):
            continue  # An unhashable key is refused elsewhere with its own message.
        if key.value in known:
            line = key.start_mark.line + 1
            raise ValueError(f"the key '{key.value}' appears twice, the second time in line {line}")
        known.add(key.value)


# -- files of this user -----------------------------------------------------------------------


_FILE_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def irregular_kind(mode: int) -> str:
    """Return a phrase describing a non-regular file from its mode; empty for a regular file."""
    if stat.S_ISREG(mode):
        return ""
    return next((words for test, words in _FILE_KINDS if test(mode)), "no file")


def read_regular(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a regular file; a pipe would block, and a device may never end.

    Raises
    ------
    OSError
        It cannot be read, or is not a regular file.
    """
    if kind := irregular_kind(os.stat(path).st_mode):
        raise OSError(f"it is {kind}")
    return Path(path).read_bytes()


def read_private(path: Path) -> bytes:
    """Return the content of a file that only this user, or root, can have modified.

    Raises
    ------
    OSError
        It cannot be read.
    UntrustedFileError
        The file belongs to another user, or others can write to it.
    """
    _require_own(path)
    return path.read_bytes()


def _require_own(path: Path) -> None:
    """Refuse a file or folder that another user owns or may write."""
    facts = path.stat()
    if facts.st_uid not in (0, os.geteuid()):
        raise UntrustedFileError(f"'{path}' belongs to user {facts.st_uid}; use your own.")
    if facts.st_mode & _OTHERS_MAY_WRITE:
        raise UntrustedFileError(
            f"others can write to '{path}' (mode {stat.S_IMODE(facts.st_mode):o}); remove their "
            f"permission with chmod go-w '{path}'."
        )


class Cache:
    """A folder of files that can be recomputed. The methods log warnings instead of raising
    exceptions.

    The last line of each file contains its key, length and SHA-256, to detect truncated files.
    The folder must belong to this user, and no other user may write into it, because its files are
    executed.

    Parameters
    ----------
    folder
        Created with mode 0700 if missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load(self, name: str, key: str) -> tuple[Path, bytes] | None:
        """Return the path and content of the file stored under this key, or None."""
        path = self.folder / name
        if not path.is_file():
            return None
        try:
            _require_own(self.folder)
            whole = path.read_bytes()
            content = whole[: whole.rfind(b"\n" + _CACHE_MAGIC + b" ")]
            if not whole.endswith(_trailer(content, key)):
                raise ValueError("it is damaged, or stored under another key")
            return path, content
        except UntrustedFileError as error:
            self._warn_of_untrusted_cache(error)
        except FileNotFoundError:
            pass  # Another process has deleted it.
        except (OSError, ValueError) as error:
            self.discard(name, getattr(error, "strerror", None) or str(error))
        return None

    def store(self, name: str, key: str, content: bytes) -> Path | None:
        """Store content under a key; return its path, or None if storing failed."""
        path = self.folder / name
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _require_own(self.folder)
            write_whole(path, content + _trailer(content, key))
        except UntrustedFileError as error:
            self._warn_of_untrusted_cache(error)
        except OSError as error:
            reason = error.strerror or str(error)
            warn_once(f"Nothing can be stored in the cache '{self.folder}': {reason}.")
        else:
            return path
        return None

    def discard(self, name: str, reason: str) -> None:
        """Delete a cached file and log the reason as a warning."""
        path = self.folder / name
        warn_once(f"'{path}' is deleted and recomputed: {reason.rstrip('.')}.")
        with suppress(OSError):
            path.unlink()

    def _warn_of_untrusted_cache(self, error: UntrustedFileError) -> None:
        warn_once(
            f"The cache '{self.folder}' is not used, because its files are executed: "
            f"{error} (Set SPACEROBOT_CACHE_DIR to another folder.)"
        )


def warn_first_time(logger: logging.Logger, folder: Path, name: str, message: str) -> None:
    """Log a warning once per installation; afterwards it is logged as a debug message.

    Parameters
    ----------
    folder
        The cache, which stores under ``name`` that the warning was logged. If this fails, the
        warning is logged each time.
    """
    cache = Cache(folder)
    # Installations that share a cache have one file each.
    entry = f"{name}-{hashlib.sha256(sys.prefix.encode()).hexdigest()[:32]}"
    known = cache.load(entry, entry) is not None
    logger.log(logging.DEBUG if known else logging.WARNING, message)
    if not known:
        cache.store(entry, entry, b"")


def _trailer(content: bytes, key: str) -> bytes:
    digest = hashlib.sha256(content).hexdigest()
    return b"\n%s %s %d %s\n" % (_CACHE_MAGIC, key.encode(), len(content), digest.encode())
