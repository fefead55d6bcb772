"""What real hands do, and what the estimators make of it.

What lives here: evaluation, limits, training, pages. What must not: estimators (``firmware_py.tremor``).
"""
