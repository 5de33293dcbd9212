"""Where Numba keeps what it has compiled, also on a machine where nothing may be written beside the package.

Numba writes to `NUMBA_CACHE_DIR`, to `__pycache__` beside the source or to the user's cache, and refuses to define a
function where it can write to none of them: a service user without a home, with a package that root installed.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"

log = logging.getLogger(__name__)


def ensure_cache(package: Path) -> None:
    """Set `NUMBA_CACHE_DIR` to a temporary directory where Numba could write nowhere; before Numba is imported.

    Processes that this one starts inherit it.
    """
    given = os.environ.get(VARIABLE)
    users = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    if (given and _can_write(Path(given))) or _can_write(package / "__pycache__") or _can_write(Path(users) / "numba"):
        return
    os.environ[VARIABLE] = str(_temporary())
    log.warning(
        "compiled code is kept in %s until that is cleared: set %s to a folder that lasts and can be written",
        os.environ[VARIABLE],
        VARIABLE,
    )


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):
        return False
    return True


def _temporary() -> Path:
    """Return a folder of this user's own, the same each time; a new one where somebody else was there before."""
    folder = Path(tempfile.gettempdir()) / f"crossloc3d_ros-numba-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        # Code is loaded from there: nobody else may write to it.
        is_own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    except OSError:
        is_own = False
    return folder if is_own else Path(tempfile.mkdtemp(prefix="crossloc3d_ros-numba-"))
