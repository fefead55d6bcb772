"""Emulates devices at the wire: sans-IO state machines written from manuals and data sheets, one file each.

What lives here: bytes in, bytes out, time as an argument, truth through methods of their own; each docstring ends
with "Model limits". What must not: a look at the driver of the same device. A protocol misunderstood twice in the
same way is the one fault that this bench cannot find.
"""
