"""Analyses the tremor of real hands, and how well the estimators follow it.

What lives here: evaluation, limits, training, pages. What must not: estimators (``firmware_py.tremor``).
"""
