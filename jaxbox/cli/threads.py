"""How many threads the command line computes on."""

import os

from jaxbox.run.processes import THREADS_VARIABLE


def compute_on_one_thread() -> None:
    """Has XLA compute on one thread, unless the user says otherwise; called before JAX computes anything.

    Most kernels take some microseconds. To share them with a second thread saves a tenth of a sweep's time
    where nothing else runs, keeps that core from reading and writing, and doubles the time while the cores
    are far from each other's caches.
    """
    os.environ.setdefault(THREADS_VARIABLE, "1")
