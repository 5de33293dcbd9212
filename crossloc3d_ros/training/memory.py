"""Keep the memory that a training step frees, for the next step."""

from __future__ import annotations

import ctypes
import logging

_LOGGER = logging.getLogger(__name__)
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # malloc.h of the GNU C library


def keep_freed_memory() -> bool:
    """Make the allocator keep freed memory instead of returning it to the system; return whether it does.

    Every step allocates the same large tensors anew. Returned to the system, each comes back as fresh pages that have
    to be faulted in and zeroed: ten times the cost of writing them.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # not the GNU C library
        _LOGGER.debug("this C library has no mallopt; freed memory goes back to the system")
        return False
    settings = ((_M_MMAP_THRESHOLD, 1 << 30), (_M_TRIM_THRESHOLD, (1 << 31) - 1), (_M_TOP_PAD, 1 << 26))
    return all(mallopt(option, value) for option, value in settings)
