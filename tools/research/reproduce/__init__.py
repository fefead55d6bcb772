"""Published figures beside ours: one table per subject, one row per figure.

What lives here: the conditions of each published figure and the run that meets them.
What must not: a figure typed in that is not the published one; a tolerance that the row does not show.
"""
