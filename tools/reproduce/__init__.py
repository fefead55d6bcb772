"""Published figures beside ours: one table per subject, one row per figure."""
