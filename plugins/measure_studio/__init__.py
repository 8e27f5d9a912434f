"""The set-up page: from cameras on a desk to a measured object, in a browser.

It calls `measure.api` and nothing else: whatever it does, a command or a notebook can do.
"""
