"""Public recordings that the documents and tests mention: what there is, under which licence, and how to get it.

Only ``fetch`` goes to the network, and only when it is called. Nothing here knows what a recording means.
"""
