"""What a notebook calls to make lengths, tips and worlds of poses, one function an action."""

from measure_lab.api.accepting import Accepted, accept
from measure_lab.api.comparing import Comparison, compare
from measure_lab.api.metrology import RestsSoFar, TipResult, pivot, rests, world, world_by_board
from measure_lab.api.reporting import report

__all__ = [
    "Accepted", "Comparison", "RestsSoFar", "TipResult", "accept", "compare", "pivot", "report",
    "rests", "world", "world_by_board",
]  # fmt: skip
