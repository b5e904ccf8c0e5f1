"""Folders of caches: the user's, or a temporary one where the user has none that can be written."""

import os
import sys
import tempfile
from functools import cache
from pathlib import Path


def home_folder(variable: str, name: str) -> Path | None:
    """Return the folder that an XDG variable names (default: `name` in the home); None if there is no home."""
    given = os.environ.get(variable) or os.path.expanduser(f"~/{name}")  # noqa: PTH111  pathlib's raises
    return None if given.startswith("~") else Path(given)


def is_writable(folder: Path | None) -> bool:
    """Return whether a folder can be written; it is created below the nearest folder that exists."""
    if folder is None:
        return False
    nearest = next((path for path in (folder, *folder.parents) if os.path.exists(path)), folder)  # noqa: PTH110
    if not os.access(nearest, os.W_OK | os.X_OK):
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # nearest is a file, or its file system refuses
        return False
    return True


@cache
def temporary_folder() -> Path:
    """Return a temporary folder of this user, which later runs find again; report it in a line on stderr."""
    folder = Path(tempfile.gettempdir()) / f"flexneedle-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    about = folder.lstat()
    if folder.is_symlink() or about.st_uid != os.getuid() or about.st_mode & 0o022:
        folder = Path(tempfile.mkdtemp(prefix="flexneedle-"))  # another user could write into the other
    choice = "NUMBA_CACHE_DIR and MPLCONFIGDIR choose others"
    print(
        f"flexneedle: no folder of caches can be written; caches are in {folder} ({choice})", file=sys.stderr
    )
    return folder


def use_matplotlib_folder() -> None:
    """Set MPLCONFIGDIR to a temporary folder if it is unset and the home cannot be written."""
    own = (home_folder("XDG_CONFIG_HOME", ".config"), home_folder("XDG_CACHE_HOME", ".cache"))
    if not os.environ.get("MPLCONFIGDIR") and not all(map(is_writable, own)):
        os.environ["MPLCONFIGDIR"] = str(temporary_folder() / "matplotlib")


def kernel_folder(name: str, home: Path, chosen: str) -> Path:
    """Return the folder `name` of compiled kernels whose sources are in `home`.

    It is in `chosen` (NUMBA_CACHE_DIR), else beside the code or in the user's cache, or in a temporary folder if these
    cannot be written.
    """
    user = home_folder("XDG_CACHE_HOME", ".cache")
    places = (Path(chosen),) if chosen else (home / "__pycache__", user and user / "flexneedle")
    found = next((place for place in places if place and is_writable(place / name)), None)
    if found is None:
        found = temporary_folder() / "kernels"
        os.environ["NUMBA_CACHE_DIR"] = str(found)  # for processes that this one starts
    return found / name
