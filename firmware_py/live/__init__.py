"""What a running firmware shows to other processes, and what it hears from them; the loop waits for neither.

What lives here: the shared memory of frames and histograms, the socket of orders.
What must not: what an order means (``control.orders``), the page (``tools.bench``).
"""
