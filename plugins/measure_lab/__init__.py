"""What a laboratory makes of poses: rests, tips, worlds, and tests by known lengths.

`measure_lab.api` holds what a notebook calls, one function an action.
"""
