"""What a notebook calls; the command line calls nothing else."""

from __future__ import annotations
