"""Programs of other people (FMUs, Python twins), each in a process of its own with limits of time and memory.

What lives here: the host that starts and asks such a process, the process itself, the bytes between them.
What must not: the decision to run one (``hal.trust``), anything that the process of a guest would import in vain.
"""
