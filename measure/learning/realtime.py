"""Asking the system to run this process without delays."""

from __future__ import annotations

import ctypes
import os

_PRIORITY = 10  # Of SCHED_FIFO: above all ordinary processes, below the kernel's own threads
_CURRENT_AND_FUTURE = 3  # MCL_CURRENT | MCL_FUTURE of mlockall(2)


def claim_realtime() -> str:
    """Schedule this process before all ordinary ones, and keep its memory from being swapped.

    Returns:
        What the system refused, in one line; empty if nothing.
    """
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (AttributeError, OSError) as problem:
        refused.append(f"priority ({getattr(problem, 'strerror', None) or 'not on this system'})")
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_CURRENT_AND_FUTURE):
            refused.append(f"locked memory ({os.strerror(ctypes.get_errno())})")
    except (AttributeError, OSError, TypeError):
        refused.append("locked memory (not on this system)")
    if not refused:
        return ""
    return (
        f"not in real time: the system refuses {' and '.join(refused)}: run as root, or let "
        "/etc/security/limits.conf allow rtprio 10 and memlock unlimited"
    )
