"""Recording: ring, recorder process, MCAP files, recovery, export, replay. Format: docs/recording-format.md."""
