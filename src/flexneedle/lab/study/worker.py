"""Setup of a worker process. Does not import NumPy, whose libraries read these settings when they are loaded."""

import multiprocessing
import os
import signal
from threading import Thread

_LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def set_up_worker() -> None:
    """Use one thread, leave Ctrl-C to the parent, and exit when the parent exits for any reason."""
    os.environ.update(dict.fromkeys(_LIBRARIES, "1"))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit with the parent: a killed parent does not close its queue, and its workers would wait forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
