"""The commands of the panel "Research": options and printing, thin over the folders beside this one.

What lives here: the table of the commands, one module per command. What must not: computation; heavy imports at the
top of a file, because every ``--help`` would pay for them.
"""
