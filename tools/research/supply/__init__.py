"""Lists what the project is made of: licences of its dependencies, and known vulnerabilities in them.

What lives here: the page of licences and the audit of CI. What must not: anything that a user's command needs.
"""
