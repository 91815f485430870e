"""Writing files: whole or not at all, never over what has to stay, never by two commands at once.

Every file that aolink writes comes from here. `writing` makes it under a name of its own beside the target and
puts it in the target's place when it is complete. `create` is for a recording that has to be readable while the
session still goes on: it is written under its final name, and takes the place of an old file when there is something
in it.

A target is a plain file or a name that is still free. Folders, symbolic links, pipes, sockets and devices are
refused before they are opened, so nothing is written through a link and nothing waits for a pipe.

Whoever writes holds a lock (``flock``) on the unfinished file. A second command that wants the same target sees
the lock and is refused. The operating system drops the lock when a process ends, however it ends, so a file that a
killed command left is known to be dead, and the next command that writes the same target removes it. On a file system
without such locks two commands still cannot damage the target: each puts a whole file there, or is refused.
"""

from __future__ import annotations

import atexit
import errno
import fcntl
import os
import random
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from aolink.errors import AolinkError

_ATTEMPTS = 6
"""Number of attempts: two commands that begin in the same instant see each other's lock, and both try again."""
_STEP_BACK_S = 0.05
"""The longest of the random waits between attempts, s."""
_LONGEST_NAME = 200
"""The most bytes of the target's name in that of the unfinished file; file systems allow 255 for the whole name."""
_UNFINISHED = re.compile(r"[0-9a-f]{16}\.partial")
"""The ending of the names of unfinished files."""
_left: dict[Path, int] = {}
"""Unfinished files that have not been removed, with the process that began them. An interruption may come while they
are being removed: then it is done at the process's end."""
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK}
"""Errors of a file system that has no hard links."""
_KINDS = {
    stat.S_IFDIR: "a folder: give the name of a file in it",
    stat.S_IFIFO: "a named pipe, and only plain files are written: give another name",
    stat.S_IFSOCK: "a socket, and only plain files are written: give another name",
    stat.S_IFCHR: "a device, and only plain files are written: give another name",
    stat.S_IFBLK: "a device, and only plain files are written: give another name",
}


def check_target(
    target: Path, *, overwrite: bool = False, sources: Iterable[Path] = (), suffix: str = "",
    error: type[AolinkError] = AolinkError,
) -> None:  # fmt: skip
    """Refuse a target that must not be written or cannot be, before any work is done for it.

    Parameters
    ----------
    overwrite:
        Whether a file of that name may be replaced.
    sources:
        Files that the new one is made from, which it may never replace.
    suffix:
        The required ending of the name, such as ``.png``; empty for any.
    error:
        The class of the error that is raised.
    """
    if suffix and target.suffix.lower() != suffix:
        raise error(f"cannot write {target}: what is written is a {suffix} file; give a name that ends with {suffix}")
    try:
        if any(target.exists() and source.exists() and target.samefile(source) for source in sources):
            raise error(f"{target} is what the new file is made from: give another name")
        kind = stat.S_IFMT(target.lstat().st_mode)
    except FileNotFoundError:
        if not target.parent.is_dir():
            raise error(f"cannot write {target}: there is no folder {target.parent}; make it first") from None
        return
    except OSError as problem:
        raise error(f"cannot write {target}: {why_not(problem)}") from None
    if kind == stat.S_IFLNK:
        raise error(f"{target} is a symbolic link: give the name of the file that it points to")
    if kind != stat.S_IFREG:
        raise error(f"{target} is {_KINDS.get(kind, 'no plain file: give another name')}")
    if not overwrite:
        raise error(_exists(target))


@contextmanager
def writing(
    target: Path, *, overwrite: bool = False, sources: Iterable[Path] = (), suffix: str = "",
    error: type[AolinkError] = AolinkError,
) -> Iterator[Path]:  # fmt: skip
    """A new, empty file beside ``target``, to be written in the block; parameters as for `check_target`.

    When the block ends well the file is brought to the disk and put in the place of ``target``, with the permissions
    that ``target`` had; a target that is new gets those that the umask leaves. When the block raises, or a signal
    ends the command, the unfinished file is removed and ``target`` stays as it was.

    Raises
    ------
    AolinkError
        An error of the class ``error``: the target is refused (`check_target`), another command is writing it, or the
        file cannot be written (any OSError in the block).
    """
    check_target(target, overwrite=overwrite, sources=sources, suffix=suffix, error=error)
    try:
        with _unfinished(target, error) as (partial, descriptor):
            yield partial
            os.fsync(descriptor)
            if not _is_open_as(partial, descriptor):
                raise error(f"cannot write {target}: another program has put a file in the place of {partial}")
            if overwrite:
                os.replace(partial, target)
            else:
                _put_where_nothing_is(partial, target)
            _sync_folder(target.parent)
    except FileExistsError:
        raise error(_exists(target)) from None
    except OSError as problem:
        raise error(f"cannot write {target}: {why_not(problem)}") from None


class NewFile:
    """A file that is being written while others may read it; it is locked until it is closed.

    Where its name is that of an old file, it is beside that one until `take_place`.
    """

    def __init__(self, path: Path, target: Path, descriptor: int, error: type[AolinkError]) -> None:
        self.path = path
        """Its name at present."""
        self.target = target
        """Its name in the end."""
        self.descriptor = descriptor
        self._error, self._closed = error, False
        self._old = None if path == target else _identity(target)

    @property
    def is_aside(self) -> bool:
        """Whether it is still beside the file that it is to replace."""
        return self.path != self.target

    def is_there(self) -> bool:
        """Whether its name is still its own: another program may have removed, renamed or replaced it."""
        return _is_open_as(self.path, self.descriptor)

    def take_place(self) -> None:
        """Put it in the place of the old file, unless another program has exchanged one of them. Raises OSError, and
        an error of the class that `create` was given."""
        check_target(self.target, overwrite=True, error=self._error)
        changed = self.target.exists() and self._old != _identity(self.target)
        if changed or not self.is_there():
            what = self.target if changed else self.path
            raise self._error(f"cannot write {self.target}: another program has put a file in the place of {what}")
        os.replace(self.path, self.target)
        self.path = self.target
        _sync_folder(self.target.parent)

    def moved_to(self) -> Path | None:
        """Where it is now that its name is no longer its own; None if it was removed, or that is not known."""
        try:
            place = Path(os.readlink(f"/proc/self/fd/{self.descriptor}"))
        except OSError:  # a system without /proc
            return None
        # NFS keeps a removed file as .nfs... until it is closed.
        return None if place.name.endswith(" (deleted)") or place.name.startswith(".nfs") else place

    def saved(self) -> Path:
        """Copy a file that was removed to a new one beside its name; gives that one. Raises OSError."""
        copy = self.path.with_name(f"{self.path.stem}-saved-{secrets.token_hex(4)}{self.path.suffix}")
        with open(os.dup(self.descriptor), "rb") as source, copy.open("xb") as new:
            source.seek(0)
            shutil.copyfileobj(source, new, 1 << 20)
            new.flush()
            os.fsync(new.fileno())
        return copy

    def close(self, *, remove: bool = False) -> None:
        """Close it; one that is still beside the old file is removed, with ``remove`` any. Raises nothing."""
        if self._closed:
            return
        self._closed = True
        with suppress(OSError):
            if (remove or self.is_aside) and self.is_there():
                self.path.unlink()
        with suppress(OSError):
            os.close(self.descriptor)


def _identity(path: Path) -> tuple[int, int, int]:
    """What tells a file from another one in its place, which may have got its number."""
    found = path.stat()
    return found.st_dev, found.st_ino, found.st_mtime_ns


def create(target: Path, *, overwrite: bool = False, error: type[AolinkError] = AolinkError) -> NewFile:
    """Create a file that is written under its final name, or beside an old file with the permissions of that.

    Raises
    ------
    AolinkError
        An error of the class ``error``: the target is refused (`check_target`), another command is writing it, or it
        cannot be created.
    """
    check_target(target, overwrite=overwrite, error=error)
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        if target.exists():
            held = list[Path]()
            try:
                partial, descriptor = _begun(target, error, held)
            except BaseException:
                _remove(held)
                raise
            return NewFile(partial, target, descriptor, error)
        descriptor = os.open(target, flags, 0o666)
        try:
            if not _lock(descriptor) or _others_write(target):
                target.unlink()
                raise error(_in_use(target))
            _sync_folder(target.parent)
        except BaseException:
            os.close(descriptor)
            raise
    except FileExistsError:
        raise error(_exists(target)) from None
    except OSError as problem:
        raise error(f"cannot create {target}: {why_not(problem)}") from None
    return NewFile(target, target, descriptor, error)


def open_unfinished(partial: Path) -> int:
    """A descriptor to write the file that `writing` gave. Raises OSError."""
    return os.open(partial, os.O_WRONLY | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC)


def is_being_written(target: Path) -> bool:
    """Whether another command is writing ``target`` at this moment."""
    try:
        return _locked_by_another(target) or _others_write(target)
    except FileNotFoundError:
        return _others_write(target)


def remove_unfinished(target: Path) -> None:
    """Remove the unfinished files of ``target`` that killed commands have left."""
    _others_write(target)


def why_not(problem: OSError) -> str:
    """The reason why a file cannot be read or written, in words."""
    if problem.errno == errno.EFBIG:
        return "it would be larger than the disk or a limit (ulimit -f) lets a file be"
    full = problem.errno in (errno.ENOSPC, errno.EDQUOT)
    return "the disk is full" if full else (problem.strerror or str(problem)).lower()


def _exists(target: Path) -> str:
    return f"{target} exists and is not overwritten: give another name, or --overwrite to replace it"


def _in_use(target: Path) -> str:
    return f"{target} is being written by another command: wait until that has ended, or give another name"


@contextmanager
def _unfinished(target: Path, error: type[AolinkError]) -> Iterator[tuple[Path, int]]:
    """A temporary file beside ``target``, open and locked, which is removed after the block unless it was renamed."""
    held, descriptor = list[Path](), -1
    try:
        partial, descriptor = _begun(target, error, held)
        yield partial, descriptor
    finally:
        _remove(held)
        if descriptor >= 0:
            os.close(descriptor)


def _remove(held: Iterable[Path]) -> None:
    for each in held:
        with suppress(OSError):
            each.unlink()
        _left.pop(each, None)


@atexit.register
def _remove_left() -> None:
    _remove([path for path, process in _left.items() if process == os.getpid()])


def _begun(target: Path, error: type[AolinkError], held: list[Path]) -> tuple[Path, int]:
    """A new file beside ``target``, open and locked, with its descriptor.

    ``held`` gets its name before there is such a file: a signal may end the command in the next instant.
    """
    for attempt in range(_ATTEMPTS):
        if attempt:
            time.sleep(random.uniform(0, _STEP_BACK_S))
        partial = target.with_name(f"{_prefix_of(target)}{secrets.token_hex(8)}.partial")
        if os.path.lexists(partial):
            continue
        held[:] = [partial]
        _left[partial] = os.getpid()
        # A private file must not be open to others even for a moment.
        mode = 0o600 if os.path.lexists(target) else 0o666
        descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
        try:
            _make_like(target, descriptor)
            # Another command that looks for dead files may take ours for one before it is locked.
            good = _lock(descriptor) and _is_open_as(partial, descriptor)
            good = good and not _others_write(target, but=partial)
            if good and not (target.exists() and _locked_by_another(target)):
                return partial, descriptor
        except BaseException:
            os.close(descriptor)
            raise
        _remove(held)
        os.close(descriptor)
    raise error(_in_use(target))


def _prefix_of(target: Path) -> str:
    """The beginning of the names of a target's unfinished files; 16 random hexadecimal digits and .partial follow."""
    return f".{os.fsdecode(os.fsencode(target.name)[:_LONGEST_NAME])}."


def _make_like(target: Path, descriptor: int) -> None:
    """Give an unfinished file the owner and permissions of ``target`` where there is one."""
    try:
        old = target.lstat()
    except FileNotFoundError:
        return
    with suppress(PermissionError):  # only the superuser may change the owner
        os.fchown(descriptor, old.st_uid, old.st_gid)
    os.fchmod(descriptor, old.st_mode & 0o777)


def _lock(descriptor: int) -> bool:
    """Lock an open file; False if another process has locked it. Where the file system has no locks, every file counts
    as locked."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def _is_open_as(path: Path, descriptor: int) -> bool:
    """Whether a path still names the file that is open."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except OSError:
        return False


def _others_write(target: Path, but: Path | None = None) -> bool:
    """Whether an unfinished file of ``target`` other than ``but`` is locked. Dead ones are removed."""
    prefix = _prefix_of(target)
    try:
        names = [
            name
            for name in os.listdir(target.parent)
            if name.startswith(prefix) and _UNFINISHED.fullmatch(name[len(prefix) :])
        ]
    except OSError:  # a folder that may be written but not read
        return False
    found = False
    for path in (target.with_name(name) for name in names):
        if path == but:
            continue
        with suppress(OSError):  # it belongs to another user, or has just been removed
            if _locked_by_another(path, remove=True):
                found = True
    return found


def _locked_by_another(path: Path, *, remove: bool = False) -> bool:
    """Whether another process holds the lock of a plain file; with ``remove`` the file is removed if none does. Raises
    OSError."""
    if not stat.S_ISREG(path.lstat().st_mode):
        return False
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if remove:
            path.unlink()
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def _put_where_nothing_is(partial: Path, target: Path) -> None:
    """Rename, unless the target has come into being meanwhile. Raises FileExistsError."""
    try:
        os.link(partial, target)  # a rename would replace it
    except OSError as problem:
        if problem.errno not in _NO_LINKS:
            raise
        if os.path.lexists(target):
            raise FileExistsError from None
        os.rename(partial, target)


def _sync_folder(folder: Path) -> None:
    """Synchronise a folder, so that a new name is on the disk. Some file systems do this by themselves and refuse the
    request."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
