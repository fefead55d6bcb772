"""Public recordings that the documents and tests mention.

What lives here: the list with licences and checksums, the downloads, the page of them. Only ``fetch`` goes to the
network, and only when it is called. What must not: the recordings themselves, and what they mean.
"""
