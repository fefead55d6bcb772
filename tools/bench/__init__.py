"""The bench page: a server of its own process that looks at a running firmware and passes orders on to it."""
