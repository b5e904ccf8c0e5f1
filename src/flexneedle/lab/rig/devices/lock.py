"""Lock on the address of a set of motors: one program at a time moves them."""

import fcntl
import hashlib
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flexneedle.errors import DriverError, make_printable

FOLDER = Path("/tmp")  # in which all users of a machine may make files; TMPDIR may be another one for each
_LONGEST = 2000


def describe_program() -> str:
    """Return number and command of this process, for the process that holds motors for it."""
    return make_printable(f"pid {os.getpid()} ({shlex.join(sys.argv)})")[:_LONGEST]


@contextmanager
def hold_motors(address: str, holder: str) -> Iterator[None]:
    """Hold the motors at an address, so that no other program can. holder: shown to the other program.

    The kernel releases them when this process ends, for any reason; the file remains without effect. Raises
    DriverError, with the holder, if another program has them.
    """
    path = lock_file(address)
    try:
        descriptor = _open_file(path)
    except OSError as error:
        raise DriverError(f"{path}: the lock of {address} cannot be opened: {error.strerror}") from None
    try:
        _lock(descriptor, address)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, holder.encode(), 0)
        yield
    finally:
        os.close(descriptor)


def lock_file(address: str) -> Path:
    """Return the lock file of an address."""
    return FOLDER / f"flexneedle-{hashlib.sha256(address.encode()).hexdigest()[:16]}.lock"


def _lock(descriptor: int, address: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(descriptor, _LONGEST, 0).decode(errors="replace") or "another program"
        raise DriverError(f"{address}: in use by {make_printable(holder)}: end it first") from None


def _open_file(path: Path) -> int:
    """Return a descriptor of the file, which is made for all users."""
    flags = os.O_RDWR | os.O_NOFOLLOW
    while True:
        try:  # with O_CREAT, Linux would refuse another user's file (fs.protected_regular)
            return os.open(path, flags)
        except FileNotFoundError:
            pass
        try:
            descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL)
        except FileExistsError:
            continue
        os.fchmod(descriptor, 0o666)  # whatever the umask is
        return descriptor
