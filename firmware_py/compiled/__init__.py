"""The loop without the interpreter: one compiled thread from the DAQ's bytes to the output's, and Python beside it.

What lives here: the thread's kernels, its memory, and the loop that hands over to it and takes over from it.
What must not: a second form of any arithmetic. The thread runs the functions that the Python loop runs, and hands over
whatever it does not decide itself, so that findings, holds and ramps have one implementation.
"""
