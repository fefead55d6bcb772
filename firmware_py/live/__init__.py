"""Exchanges data between a running firmware and other processes; the loop never waits for them.

What lives here: the shared memory of frames and histograms, the socket of orders.
What must not: what an order means (``control.orders``), the page (``tools.bench``).
"""
