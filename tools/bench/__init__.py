"""The bench page: a server of its own process that looks at a running firmware and passes orders on to it.

What lives here: session with the firmware, viewers, recordings, jobs, the page's files in ``static``.
What must not: anything that the loop could wait for.
"""
