"""What a worker process does first. Nothing here loads NumPy: its libraries read their settings as they load."""

import multiprocessing
import os
import signal
from threading import Thread

_LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def set_up() -> None:
    """Use one thread, leave Ctrl-C to the parent, and end when the parent does, however it ends."""
    os.environ.update(dict.fromkeys(_LIBRARIES, "1"))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed parent closes no queue, on which its workers would wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
