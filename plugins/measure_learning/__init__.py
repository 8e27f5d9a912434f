"""A robot's position error learnt from its states: logs, data sets, training, correction.

`measure_learning.api` holds what a notebook calls, one function an action.
"""
