"""A faster memory allocator for processes that simulate.

In every step Drake's solver makes and drops some thousand small blocks, with glibc's allocator a third of a step.
Google's tcmalloc takes half of that, and glibc itself a bit less when its caches hold more than 7 blocks of a size.
Either must be said before a process starts.
"""

from __future__ import annotations

import os
import signal
import sys
import sysconfig
from pathlib import Path

#: As Debian's and Ubuntu's package libtcmalloc-minimal4 and Fedora's gperftools-libs install it.
LIBRARY = "libtcmalloc_minimal.so.4"


def allocator_environment() -> dict[str, str]:
    """Variables for the environment of a process that will simulate; none where they are set or not known to help."""
    if sys.platform != "linux" or {"LD_PRELOAD", "GLIBC_TUNABLES"} & set(os.environ):
        return {}
    if any((folder / LIBRARY).exists() for folder in _library_folders()):
        return {"LD_PRELOAD": LIBRARY}
    return {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=2000"}


def restart_with_faster_allocator() -> None:
    """Starts this program again under `allocator_environment`, as the same process; at most once.

    To be called before anything is done or imported that takes time, by a program that unblocks SIGINT when it starts.
    It does nothing where the program is no file:
    there is no second start of what came from a pipe.
    """
    environment = allocator_environment()
    if environment and Path(sys.argv[0]).is_file():
        # Until the program has its own handler again, Ctrl-C waits: Python's start turns it into a traceback.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | environment)


def _library_folders() -> list[Path]:
    return [Path("/usr/lib", sysconfig.get_config_var("MULTIARCH") or ""), Path("/usr/lib64")]
