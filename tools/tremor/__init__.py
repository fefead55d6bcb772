"""What real hands do, and what the estimators make of it."""
