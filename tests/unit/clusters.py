"""Dask clusters on this machine."""

from __future__ import annotations

from typing import Any

import pytest


def local_cluster(workers: int) -> Any:
    """Return a cluster of processes with one thread each, without a page; the test is skipped without Dask."""
    distributed = pytest.importorskip("distributed")
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
        silence_logs=50,
    )
