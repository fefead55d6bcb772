"""What people see of a diagnosis: terminal, page, vocabulary, and what to record next."""
