"""Entry points of the installed package under names that are ours alone.

What lives here: modules that are installed beside our packages and put them first on the import path.
What must not: anything else; other people have packages called tools and hal, too. This file is not installed.
"""
