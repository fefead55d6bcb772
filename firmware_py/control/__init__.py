"""Where the parts become an instrument: wiring, the loop, its tasks, and the supervisor that may stop it."""
